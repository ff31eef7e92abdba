"""The walk through Brown & Colgate 1997: its page, its checks, and that a wrong number shows."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.lab.paper import STEPS, device_damping, impact, integrators, transmission_line
from hapticbridge.lab.paper.section import PAGE, Check, Relation
from hapticbridge.theory.sampled_loop import stability_limit

SCRIPT = Path(__file__).parents[1] / "scripts" / "reproduce_paper"
Change: TypeAlias = Callable[[Any], Any]
EQUATIONS = (1, 2, 4, 5, 6, 7, 11, 13, 14, 15, 16, 17, 18, 19)


def script() -> dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


def run(folder: Path) -> int:
    return int(script()["main"]([str(folder)]))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    folder = tmp_path_factory.mktemp("walk") / "made" / "on the way"
    return run(folder), folder


def test_every_number_is_reproduced(walk: tuple[int, Path]) -> None:
    code, folder = walk
    page = (folder / PAGE).read_text(encoding="utf-8")
    assert code == 0
    assert "all pass" in page
    assert "FAIL" not in page


def test_page_walks_through_every_equation_with_its_picture(walk: tuple[int, Path]) -> None:
    page = (walk[1] / PAGE).read_text(encoding="utf-8")
    headings = " ".join(line for line in page.splitlines() if line.startswith("<h2"))
    for equation in EQUATIONS:
        assert f"({equation})" in headings
        assert f"<td>({equation})</td>" in page, "no check"
    for other in ("§4", "worst hand", "future work"):
        assert other in headings
    assert page.count("<figure><svg") == len(STEPS)
    assert len(list(walk[1].glob("*.png"))) == len(STEPS)


def scaled(factor: float) -> Change:
    return lambda function: lambda *given, **named: factor * np.asarray(function(*given, **named))


def heavier(factor: float) -> Change:
    return lambda function: lambda mass, *given, **named: function(factor * mass, *given, **named)


def explicit(function: Any) -> Any:
    return lambda mass, force, period, _, **named: function(
        mass, force, period, "explicit", **named
    )


@pytest.mark.parametrize(
    ("module", "section", "name", "broken", "equation"),
    [
        (device_damping, "direct_section", "maximum_stiffness", scaled(1.001), "(1)"),
        (device_damping, "backward_difference", "damping_spectrum", scaled(1 + 1e-8), "(6)"),
        (device_damping, "backward_difference", "wall_limit", scaled(1.003), "(6)"),
        (integrators, "discrete_passivity_section", "integrate_particle", explicit, "(13)"),
        (integrators, "implicit_euler_section", "integrate_particle", heavier(1.01), "(16)"),
        (integrators, "explicit_euler_section", "integrate_particle", heavier(1.01), "(18)"),
        (integrators, "virtual_mass_section", "smallest_mass_in_mujoco", scaled(1.003), "(19)"),
        (
            integrators,
            "virtual_mass_section",
            "environment_minimum_damping",
            scaled(1.0001),
            "(19)",
        ),
        (impact, "section", "RESTITUTION", lambda e: e + 1e-6, "§4"),
        (device_damping, "worst_hand_section", "wall_damping", scaled(1.002), "worst hand"),
        (device_damping, "worst_hand_section", "limit_of", scaled(1.002), "worst hand"),
        (transmission_line, "section", "transmission_line_stiffness", scaled(1.001), "future"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_wrong_number_is_reported(
    module: Any,
    section: str,
    name: str,
    broken: Change,
    equation: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, name, broken(getattr(module, name)))
    # one mass of the table is enough
    monkeypatch.setattr(integrators, "KEPT", {0.05: integrators.KEPT[0.05]})
    failed = [check for check in getattr(module, section)().checks if not check.has_passed]
    assert failed
    assert any(check.equation.startswith(equation) for check in failed)


def test_script_fails_and_names_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(device_damping, "stability_limit", scaled(1.01)(stability_limit))
    names = script()
    monkeypatch.setitem(names["computed"].__globals__, "STEPS", (STEPS[0],))
    assert names["main"]([str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "fails (1) b_θ" in printed
    assert "time-domain loop" in printed
    assert "4 checks, 1 fail" in printed
    assert "FAIL" in (tmp_path / PAGE).read_text(encoding="utf-8")


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_a_folder_that_cannot_be_one_is_refused_in_a_sentence(
    tmp_path: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("kept", encoding="utf-8")
    assert run(tmp_path / place) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert (tmp_path / "file").read_text(encoding="utf-8") == "kept"


def check_of(expected: float, got: float, relation: Relation, tolerance: float = 1e-9) -> Check:
    return Check(
        equation="(6)", quantity="b", route="none", expected=expected, got=got,
        tolerance=tolerance, relation=relation,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("expected", "got", "relation", "deviation"),
    [
        (2.0, 2.5, "equals", 0.25),
        (-2.0, -2.5, "equals", 0.25),
        (0.0, -3.0, "equals", 3.0),
        (2.0, 2.5, "at most", 0.25),
        (2.0, 1.0, "at most", 0.0),
        (-2.0, -1.0, "at most", 0.5),
        (2.0, 1.0, "at least", 0.5),
        (-2.0, -1.0, "at least", 0.0),
        (np.inf, np.inf, "equals", 0.0),
        (np.inf, 1.0, "equals", np.inf),
        (1.0, np.inf, "equals", np.inf),
        (np.inf, 1.0, "at least", np.inf),
    ],
)
def test_deviation_is_relative_and_one_sided_for_bounds(
    expected: float, got: float, relation: Relation, deviation: float
) -> None:
    check = check_of(expected, got, relation)
    assert check.deviation == deviation
    assert check.has_passed == (deviation == 0)


@given(st.sampled_from(["equals", "at most", "at least"]), st.floats(allow_nan=False))
def test_nothing_that_is_no_number_passes(relation: Relation, expected: float) -> None:
    assert not check_of(expected, np.nan, relation, tolerance=np.inf).has_passed


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_equals_itself_at_no_tolerance(value: float) -> None:
    assert check_of(value, value, "equals", tolerance=0.0).has_passed
