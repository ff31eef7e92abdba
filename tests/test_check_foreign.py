"""Scenes from elsewhere: what their authors read is right, and enough to mend them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from check_scenes import GOOD_CONTACT, GOOD_OPTION, case_of, faults_of, kinds, written
from outside_scenes import FREE_TOOL, mjcf

from hapticbridge.check import lean
from hapticbridge.check.fault import Fault, number
from hapticbridge.check.inventory import take_inventory
from hapticbridge.check.lean import MAY_GO
from hapticbridge.check.simplify import OTHER_MOTIONS, Simplification
from hapticbridge.check.source_map import Place
from hapticbridge.check.version import SceneVariant, Setting, name_everything
from hapticbridge.check.witness import witness
from hapticbridge.cli import main
from hapticbridge.cli.check import MOST_NAMED, print_faults
from hapticbridge.cli.main import USAGE_ERROR
from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.scene import read_scene

Capsys = pytest.CaptureFixture[str]

STILL = "t,x,y,z\n0,0,0,0\n0.1,0,0,0\n"
BALL = """<body name="tool" pos="0 0 0.05"><freejoint/><geom name="ball" size="0.01" mass="0.1"/>
  <site name="grip"/></body>"""
BRICKS = "".join(
    f'<geom name="brick_{k}" type="box" size="0.01 0.01 0.01" pos="{0.05 * k} 0 -0.01"/>'
    for k in range(3)
)


def change_of(kind: str, faults: tuple[Fault, ...]) -> Fault:
    return next(fault for fault in faults if fault.kind == kind)


@pytest.mark.parametrize(
    "words",
    ['<geom size="0.01" pos="0 nan 0"/>', '<geom size="0.01" solref="NaN 1"/>'],
    ids=["pos", "solref"],
)
def test_nan_is_refused_with_its_line(tmp_path: Path, words: str, capfd: Capsys) -> None:
    scene = written(tmp_path, mjcf("\n", "\n", body=BALL, world=words))
    with pytest.raises(SceneError, match=r"scene.xml, line 4: .* of <geom> is '.*'; write a n"):
        read_scene(scene)
    capfd.readouterr()  # MuJoCo's own warning


def test_something_called_nan_is_no_number(tmp_path: Path, capfd: Capsys) -> None:
    pair = '<contact><exclude body1="nan" body2="tool"/></contact>'
    text = mjcf(body=FREE_TOOL, world='<body name="nan"><geom size="0.01"/></body>')
    text = text.replace("</mujoco>", f"{pair}</mujoco>")
    assert read_scene(written(tmp_path, text)).spec.body("nan") is not None
    capfd.readouterr()


def test_options_are_written_where_they_are_missing(tmp_path: Path) -> None:
    faults = faults_of(written(tmp_path, mjcf(body=BALL), STILL))
    changes = [change_of(kind, faults).change for kind in ("integrator", "time step")]
    assert [change.split(" in <mujoco>")[0] for change in changes] == [
        '<option integrator="discrete"/>',
        '<option timestep="0.001"/>',
    ]
    # MuJoCo takes several of them
    mended = mjcf(*(change.split(" in <mujoco>")[0] for change in changes), body=BALL)
    assert not {"integrator", "time step"} & kinds(faults_of(written(tmp_path, mended, STILL)))


def test_flag_joins_the_one_that_is_there(tmp_path: Path) -> None:
    text = mjcf('<option>\n<flag energy="enable"/></option>', body=BALL)
    fault = change_of("diagexact", faults_of(written(tmp_path, text, STILL)))
    assert (fault.place.line, fault.change) == (2, 'diagexact="enable"')


def test_one_line_mends_the_default_contact_of_many_geoms(tmp_path: Path) -> None:
    fault = change_of(
        "default contact",
        faults_of(written(tmp_path, mjcf(GOOD_OPTION, body=BALL, world=BRICKS), STILL)),
    )
    line = fault.change.split("at once: ")[1].removesuffix(" in <default>")
    mended = mjcf(GOOD_OPTION, f"<default>{line}</default>", body=BALL, world=BRICKS)
    assert "default contact" not in kinds(faults_of(written(tmp_path, mended, STILL)))


def test_floor_under_a_flex_is_not_called_idle(tmp_path: Path) -> None:
    cloth = """<geom name="floor" type="plane" size="1 1 1"/><flexcomp name="cloth" type="grid"
      count="3 3 1" spacing="0.02 0.02 0.02" pos="0 0 0.002" mass="0.1" radius="0.003" dim="2">
      <edge equality="true"/></flexcomp>"""
    scene = written(tmp_path, mjcf(GOOD_OPTION, body=BALL, world=cloth), STILL)
    case = case_of(scene)
    inventory = take_inventory(case.model, "grip", case.places, case.observation)
    assert inventory.flexes == 1
    assert not inventory.idle
    draft = SceneVariant(case.source, "grip", Setting(case.coupling))
    assert "floor" in witness(draft, case.motion).near_geoms


@pytest.mark.parametrize(("mass", "is_told"), [(0.05, True), (20.0, False)])
def test_limit_that_hardly_gives_is_not_called_soft(
    tmp_path: Path, mass: float, is_told: bool
) -> None:
    arm = f"""<body name="tool" gravcomp="1"><joint axis="0 0 1" range="-1 1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="{mass}"/>
      <site name="grip" pos="0.3 0 0"/></body>"""
    text = mjcf('<compiler angle="radian"/>', GOOD_OPTION, GOOD_CONTACT, body=arm)
    assert ("soft limit" in kinds(faults_of(written(tmp_path, text, STILL)))) == is_told


def test_bare_lever_is_told_to_have_damping_and_then_creates_nothing(tmp_path: Path) -> None:
    # joint friction, however little, keeps a tool from being rendered losslessly
    lever = """<body name="tool" pos="0 0 0.1"><joint name="h" axis="0 1 0" frictionloss="1e-9"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.0356"/>
      <site name="grip" pos="0.1 0 0"/></body>"""
    fault = change_of(
        "energy created",
        faults_of(written(tmp_path, mjcf(GOOD_OPTION, GOOD_CONTACT, body=lever))),
    )
    assert fault.place.element == "joint 'h'"
    damping = fault.change.split(" or more")[0]
    mended = lever.replace('name="h"', f'name="h" {damping}')
    text = mjcf(GOOD_OPTION, GOOD_CONTACT, body=mended)
    assert "energy created" not in kinds(faults_of(written(tmp_path, text)))


def test_what_has_no_name_is_called_after_its_body() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><geom size="1"/><body name="cup"><freejoint/><geom size="1"/>'
        '<geom size="1"/><geom name="cup_geom" size="1"/></body></worldbody></mujoco>'
    )
    name_everything(spec)
    assert [joint.name for joint in spec.joints] == ["cup_joint"]
    assert [geom.name for geom in spec.geoms] == [
        "world_geom",
        "cup_geom_2",
        "cup_geom_3",
        "cup_geom",
    ]


@pytest.mark.parametrize(("again", "is_taken"), [(1.0, False), (0.5, True)])
def test_saving_that_is_gone_when_measured_again_is_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: float, is_taken: bool
) -> None:
    def relax(draft: SceneVariant) -> bool:
        draft.spec.option.tolerance = 1e-6
        return True

    only = Simplification("tolerance", "the solver stops earlier", relax)
    monkeypatch.setattr(lean, "_simplifications", lambda *_: [only])
    costs = iter([1.0, 0.5, 0.5, again])  # against itself, alone, together, and the whole again
    found = lean.find_lean(
        read_scene(written(tmp_path, mjcf(GOOD_OPTION, GOOD_CONTACT, body=BALL))),
        "grip",
        Motion([0.0, 0.1], [(0, 0, 0)] * 2),
        Setting(Coupling(2400.0, 0.5, 2.4, 5e-4)),
        cost=lambda *_: (1.0, next(costs, 1.0)),
    )
    assert [trial.verdict for trial in found.alone] == [MAY_GO]
    assert bool(found.together) == is_taken
    assert found.result.cost == pytest.approx(again)
    assert found.draft.spec.option.tolerance == (1e-6 if is_taken else 1e-8)


def test_what_another_motion_may_miss_is_taken_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def edit(draft: SceneVariant) -> bool:
        draft.spec.option.tolerance *= 2.0
        return True

    risky = Simplification("risky", "saves most", edit, loses=OTHER_MOTIONS)
    plain = [Simplification(name, "loses nothing", edit) for name in ("some", "more")]
    monkeypatch.setattr(lean, "_simplifications", lambda *_: [risky, *plain])
    costs = iter([1.0, 0.3, 0.8, 0.6])  # against itself, then each alone
    found = lean.find_lean(
        read_scene(written(tmp_path, mjcf(GOOD_OPTION, GOOD_CONTACT, body=BALL))),
        "grip",
        Motion([0.0, 0.1], [(0, 0, 0)] * 2),
        Setting(Coupling(2400.0, 0.5, 2.4, 5e-4)),
        cost=lambda *_: (1.0, next(costs, 0.5)),
    )
    assert [trial.name for trial in found.together] == ["more", "some", "risky"]


@pytest.mark.parametrize("option", ["--write", "--table", "--plot"])
def test_folder_that_is_missing_is_told_before_anything_runs(
    tmp_path: Path, option: str, capsys: Capsys
) -> None:
    ending = {"--write": "xml", "--table": "csv", "--plot": "png"}[option]
    target = tmp_path / "gone" / f"x.{ending}"
    assert main(["check", "peg_in_hole", option, str(target)]) == USAGE_ERROR
    said = capsys.readouterr()
    assert "its folder does not exist" in said.err
    assert not said.out


def test_faults_of_one_kind_are_printed_a_few_and_counted_all(capsys: Capsys) -> None:
    faults = tuple(
        Fault("margin", Place("s.xml", k, f"geom {k}"), 'has solref "0.02 1"', 'margin="0"')
        for k in range(MOST_NAMED + 3)
    )
    print_faults(faults)
    said = capsys.readouterr().out
    assert f"{len(faults)} found" in said
    assert said.count("write:") == MOST_NAMED
    assert "and 3 more of 'margin'" in said


def test_what_stands_in_quotes_is_not_cut_at_the_end_of_a_line(capsys: Capsys) -> None:
    for before in range(60, 100):
        print_faults((Fault("x", Place("s.xml", 1, "g"), f'{"a" * before} "0.02 1" b', "c"),))
    assert capsys.readouterr().out.count('"0.02 1"') == 40


@pytest.mark.parametrize(("value", "text"), [(4.734e-5, "0.0000473"), (2370.0, "2370"), (0.0, "0")])
def test_number_has_no_exponent(value: float, text: str) -> None:
    assert number(value) == text
