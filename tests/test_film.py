"""Recordings drawn off-screen: where the tool is seen, and what is said where nothing can be."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import film_work
import mujoco
import numpy as np
import pytest
from audit_cases import COUPLING, ScriptedDevice, SlowClock, recorded, rewritten
from cli_cases import Called
from PIL import Image, ImageSequence
from report_runs import circling

import hapticbridge as hb
from hapticbridge.cli import main
from hapticbridge.confinement import ForeignSceneError
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.codes import HANDLE
from hapticbridge.recording import read_recording
from hapticbridge.replay.film import Shot, draw, still
from hapticbridge.replay.stage import Stage, film_ticks, force_colour, write_film
from hapticbridge.signals import StopSignal, interrupting_on_signals

SCENE = """<mujoco model="two">
  <option timestep="0.001" integrator="discrete" gravity="0 0 0"/>
  <statistic center="0 0 0" extent="0.2"/>
  <worldbody>
    <light pos="0 0 1"/>
    <camera name="above" pos="0 0 0.5" fovy="45"/>
    <geom type="plane" size="0.2 0.2 0.01" pos="0 0 -0.05" rgba="0.9 0.9 0.9 1"/>
    <body name="tool">
      <freejoint/>
      <geom name="tool" size="0.01" mass="0.1" rgba="0 0 1 1" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def sway(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball that follows a hand through the picture."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "hand.csv").write_text("t,x,y,z\n0,0,0,0\n0.2,0.06,0.03,0.02\n0.3,-0.05,0,0.05\n")
    path = folder / "sway.mcap"
    recorded(path, str(folder / "scene.xml"), f"trajectory:{folder / 'hand.csv'}")
    return path


def test_the_tool_is_seen_where_the_record_says_at_the_moment_asked_for(
    sway: Path, call: Called, tmp_path: Path
) -> None:
    records = read_recording(sway).ticks
    for tick, moment in ((0, "0"), (200, "0.2")):
        picture = tmp_path / f"{tick}.png"
        asked = ("render", sway, picture, "--at", moment, "--width", "160", "--height", "120")
        code, out, err = call(*asked, "--camera", "above")
        assert (code, f"wrote {picture}" in out) == (0, True), err
        pixels = np.asarray(Image.open(picture).convert("RGB"), dtype=int)
        assert pixels.shape == (120, 160, 3)
        seen = np.argwhere(pixels[..., 2] > 2 * pixels[..., 0] + 20).mean(axis=0)
        # a pinhole that looks down: half of 45 degrees is half of the picture
        x, y, z = records["tool_position"][tick]
        scale = 60 / np.tan(np.radians(22.5)) / (0.5 - z)
        assert seen == pytest.approx((60 - scale * y, 80 + scale * x), abs=3)
    with pytest.raises(RecordingError, match=f"'{sway}' has no camera 'below'; it has cameras: "):
        draw(sway, tmp_path / "below.png", Shot(camera="below"))
    code, _, err = call(*asked)
    assert (code, "exists" in err) == (2, True)


def test_a_scene_without_a_light_is_lit_and_one_with_its_own_stays(
    sway: Path, tmp_path: Path
) -> None:
    dark = SCENE.replace('<light pos="0 0 1"/>', "")
    visual = '<visual><headlight ambient="0.05 0.05 0.05" diffuse="0 0 0"/></visual>'
    chosen = dark.replace("<statistic", f"{visual}<statistic")
    shot = Shot(at=0.0, camera="above", width=160, height=120)

    def floor(scene: str, name: str) -> float:
        file, picture = tmp_path / f"{name}.xml", tmp_path / f"{name}.png"
        file.write_text(scene)
        recorded(tmp_path / f"{name}.mcap", str(file), f"trajectory:{sway.parent / 'hand.csv'}")
        draw(tmp_path / f"{name}.mcap", picture, shot)
        patch = np.asarray(Image.open(picture).convert("L"))[20:30, 110:120]
        return float(np.median(patch))

    assert floor(dark, "dark") > 180, "MuJoCo's own headlight gives 141"
    assert floor(chosen, "chosen") < 60, "a headlight that the file sets is the author's"


def test_tool_and_fixture_of_a_scene_without_colours_are_told_apart(
    sway: Path, tmp_path: Path
) -> None:
    scene, record, picture = (tmp_path / f"grey.{ending}" for ending in ("xml", "mcap", "png"))
    scene.write_text(re.sub(' rgba="[^"]*"', "", SCENE))
    recorded(record, str(scene), f"trajectory:{sway.parent / 'hand.csv'}")
    draw(record, picture, Shot(at=0.0, camera="above", width=160, height=120))
    pixels = np.asarray(Image.open(picture).convert("RGB"), dtype=float)
    warmth = pixels[..., 0] - pixels[..., 2]  # red beyond blue; MuJoCo's grey has none
    assert np.median(warmth[20:30, 110:120]) < 0, "the floor is a cool grey"
    assert warmth.max() > 40, "the tool is copper"


# imageio-ffmpeg leaves its pipes to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("script", ["", "#!/bin/sh\nexit 1"])
def test_an_ffmpeg_that_fails_is_an_error_and_what_was_there_stays(
    script: str, sway: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="a film needs the extra 'view'")
    program, film = tmp_path / "ffmpeg", tmp_path / "films" / "sway.mp4"
    if script:
        program.write_text(script)
        program.chmod(0o755)
    film.parent.mkdir()
    film.write_bytes(b"an older film")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    frames = iter([np.zeros((48, 64, 3), dtype=np.uint8)] * 50)
    with pytest.raises(HapticBridgeError, match="ffmpeg cannot write the film"):
        write_film(str(tmp_path / "film.mp4"), frames, (64, 48), 30)
    with pytest.raises(HapticBridgeError):
        draw(sway, film, Shot(width=64, height=48))
    assert film.read_bytes() == b"an older film"
    assert list(film.parent.iterdir()) == [film]


# imageio-ffmpeg leaves its pipes to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full is Linux's")
def test_a_full_disk_is_the_reason_why_a_film_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="a film needs the extra 'view'")
    program, film = tmp_path / "ffmpeg", tmp_path / "film.mp4"
    program.write_text("#!/bin/sh\nexec cat >/dev/null")  # a film without frames remains
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    for path, reason in (("/dev/full", "No space left on device"), (film, "")):
        frames = iter([np.zeros((48, 64, 3), dtype=np.uint8)] * 5)
        with pytest.raises(HapticBridgeError) as refused:
            write_film(str(path), frames, (64, 48), 30)
        assert str(refused.value).endswith(reason)
        assert ("No space" in str(refused.value)) == bool(reason)


def test_a_part_of_a_run_is_filmed_as_slowly_as_asked_for(sway: Path) -> None:
    stage = Stage(sway)
    assert list(film_ticks(stage, 30))[:4] == [0, 32, 66, 99]  # frames keep the run's time
    ticks = list(film_ticks(stage, 30, start=0.1, stop=0.2, speed=0.1))
    assert len(ticks) == 30  # a tenth of a second in a whole one
    assert (ticks[0], ticks[3], ticks[-1]) == (99, 109, 196)
    # a film of 0.25 s has frames at 0, 0.1 and 0.2 s
    assert list(film_ticks(stage, 10, stop=0.25)) == [0, 99, 199]
    assert list(film_ticks(stage, 10, stop=0.2)) == [0, 99]
    with pytest.raises(RecordingError, match=r"lasts from 0 to 0\.3"):
        next(film_ticks(stage, 30, stop=0.4))
    with pytest.raises(RecordingError, match=r"lasts from 0 to 0\.3"):
        stage.tick_at(0.4)


# imageio-ffmpeg leaves its pipes to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_film_has_a_frame_for_every_thirtieth_of_a_second(sway: Path, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="a film needs the extra 'view'")
    film, told = tmp_path / "sway.mp4", []
    shot = Shot(width=160, height=120)
    draw(sway, film, shot, lambda *done: told.append(done))
    frames = ffmpeg.read_frames(str(film))
    facts = next(frames)
    assert facts["source_size"] == (160, 120)
    assert facts["fps"] == pytest.approx(30)
    assert told[-1] == (10, 10)  # the last one at 0.3 s of 0.301
    assert sum(1 for _ in frames) == 10


def test_animated_picture_has_a_frame_for_every_tenth_of_a_second(
    sway: Path, tmp_path: Path
) -> None:
    film = tmp_path / "sway.gif"
    draw(sway, film, Shot(width=160, height=120, fps=10))
    with Image.open(film) as picture:
        assert picture.size == (160, 120)
        assert len(list(ImageSequence.Iterator(picture))) == 4
        assert picture.info["duration"] == 100
        assert picture.info["loop"] == 0
        picture.seek(0)
        first = np.asarray(picture.convert("RGB"), float)
        picture.seek(2)
        assert np.abs(np.asarray(picture.convert("RGB"), float) - first).max() > 50.0


def test_stage_stands_where_a_second_run_of_the_scene_does(sway: Path) -> None:
    stage = Stage(sway)
    for tick in (0, 150, 300):
        stage.show(tick)
        recorded_at = read_recording(sway).ticks["tool_position"][tick]
        np.testing.assert_allclose(stage.data.site("grip").xpos, recorded_at, atol=1e-12)
        assert stage.row["tick"][0] == tick
    handle = stage.data.mocap_pos[stage.model.body(HANDLE).mocapid[0]]
    np.testing.assert_allclose(handle, stage.row["handle_position"][0], atol=1e-12)


def test_a_late_run_is_drawn_with_the_damping_of_its_device(tmp_path: Path) -> None:
    # after a late sample the handle slips, and that slip depends on the device's damping
    path = tmp_path / "late.mcap"
    clock = SlowClock(dict.fromkeys(range(20, 200, 3), 4))
    device = ScriptedDevice(circling, damping=1.3)
    recorded(path, "point_mass", device, COUPLING, duration=0.4, clock=clock)
    last = read_recording(path).ticks[-1]
    stage = Stage(path)
    stage.show(int(last["tick"]))
    np.testing.assert_allclose(stage.data.site("grip").xpos, last["tool_position"], atol=1e-12)


def test_coupling_is_drawn_from_tool_to_handle_in_the_colour_of_its_force(sway: Path) -> None:
    stage = Stage(sway)
    stage.show(250)
    scene = mujoco.MjvScene(stage.model, maxgeom=10)
    stage.add_coupling(scene)
    # no hand feels a prescribed motion, so no arrow is drawn
    ghost, spring = scene.geoms[: scene.ngeom]
    row = stage.row[0]
    np.testing.assert_allclose(ghost.pos, row["handle_position"], atol=1e-7)
    middle = 0.5 * (row["handle_position"] + row["tool_position"])
    np.testing.assert_allclose(spring.pos, middle, atol=1e-7)
    pull = float(np.linalg.norm(row["wrench_on_tool"][:3]))
    colour = force_colour(pull, stage.tool_reference)
    np.testing.assert_allclose(spring.rgba[:3], np.asarray(colour, float), atol=1e-6)


def test_a_changed_record_is_not_drawn(sway: Path, tmp_path: Path) -> None:
    recording = read_recording(sway)
    ticks = recording.ticks.copy()
    ticks["tool_position"][100, 0] += 2e-4
    stage = Stage(rewritten(recording, tmp_path / "moved.mcap", ticks=ticks))
    stage.show(99)
    with pytest.raises(RecordingError, match="record of tick 100"):
        stage.show(100)
    ticks["tool_position"][100, 0] -= 1.5e-4
    Stage(rewritten(recording, tmp_path / "nearly.mcap", ticks=ticks)).show(100)
    versions = json.dumps({"mujoco": "3.0.0", "hapticbridge": hb.__version__, "numba": "0"})
    with pytest.raises(RecordingError, match="recorded with mujoco 3"):
        Stage(rewritten(recording, tmp_path / "old.mcap", meta={"versions": versions}))


@pytest.mark.parametrize("command", ["render", "view"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data + b"more", "its end is followed by 4 more bytes"),
        (lambda data: data[:-30], "the file is cut: its end is missing"),
    ],
)
def test_what_shows_a_damaged_or_cut_run_says_so(
    sway: Path,
    tmp_path: Path,
    call: Called,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    change: Callable[[bytes], bytes],
    words: str,
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(change(sway.read_bytes()))
    monkeypatch.setattr("hapticbridge.cli.recordings.draw", lambda *_, **__: "egl")
    target = ("--save", tmp_path / "run.html") if command == "view" else (tmp_path / "run.mp4",)
    code, _, err = call(command, path, *target)
    assert code == 0
    assert f"run.mcap: {words}" in " ".join(err.split())
    assert "; this is what it holds" in " ".join(err.split())


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Puts functions of ``film_work`` in the place of some of the drawing process.

    MuJoCo imports there whatever draws here: it is asked for no renderer.
    """
    monkeypatch.setenv("PYTHONPATH", str(Path(film_work.__file__).parent))
    monkeypatch.setattr("hapticbridge.replay.film.RENDERERS", ("disable",))
    monkeypatch.delenv("MUJOCO_GL", raising=False)

    def replace(**functions: Callable[..., object]) -> None:
        for name, function in functions.items():
            monkeypatch.setattr(f"hapticbridge.replay.film._{name}", function)

    return replace


def test_what_is_no_answer_of_the_drawing_process_is_passed_over(
    sway: Path, tmp_path: Path, work: Callable[..., None]
) -> None:
    work(load=film_work.nothing, draw=film_work.babble)
    heard: list[tuple[int, int]] = []
    draw(sway, tmp_path / "a.png", progress=lambda *done: heard.append(done))
    assert (tmp_path / "a.png").read_bytes() == b"drawn"
    assert heard == [(3, 4)]


@pytest.mark.parametrize("is_trusted", [False, True])
def test_a_driver_that_crashes_ends_its_own_process_alone(
    is_trusted: bool, sway: Path, tmp_path: Path, work: Callable[..., None]
) -> None:
    target = tmp_path / "a.png"
    target.write_bytes(b"an older picture")
    work(load=film_work.crash)
    with pytest.raises(HapticBridgeError, match="neither EGL nor OSMesa works"):
        draw(sway, target, in_process=is_trusted)
    work(load=film_work.nothing, draw=film_work.crash)
    with pytest.raises(ForeignSceneError, match=r"crashed MuJoCo \(SIGSEGV\)"):
        draw(sway, target, in_process=is_trusted)
    assert target.read_bytes() == b"an older picture"
    assert list(tmp_path.iterdir()) == [target]


def test_where_no_renderer_works_a_sentence_says_what_to_install(
    sway: Path, call: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.replay.film.RENDERERS", ("disable",))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    code, _, err = call("render", sway, tmp_path / "a.png")
    assert code == 2
    assert "libosmesa6" in err
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(HapticBridgeError, match="MUJOCO_GL=disable does not work"):
        still(sway, Shot())


@pytest.mark.parametrize("name", ["glfw", "glx"])
def test_a_renderer_that_needs_a_display_is_the_reason_where_there_is_none(
    sway: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    monkeypatch.setenv("MUJOCO_GL", name)
    with pytest.raises(HapticBridgeError, match=f"MUJOCO_GL={name} does not .* try egl or osmesa"):
        still(sway, Shot())


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_ends_the_drawing_at_once(
    sway: Path, tmp_path: Path, work: Callable[..., None], name: str
) -> None:
    work(load=film_work.nothing, draw=film_work.sleep)
    main, number = threading.get_ident(), signal.Signals[name]
    timer = threading.Timer(0.3, signal.pthread_kill, (main, number))
    began = time.monotonic()
    with pytest.raises(StopSignal), interrupting_on_signals():
        timer.start()
        draw(sway, tmp_path / "sway.png", Shot())
    assert time.monotonic() - began < 30.0


def test_a_picture_without_a_time_is_that_of_the_largest_force(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    with hb.Bridge("virtual_wall", clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(duration=1.5)
    shots: list[Shot] = []
    monkeypatch.setattr(
        "hapticbridge.cli.recordings.draw", lambda *words, **_: shots.append(words[2])
    )
    for name in ("run.png", "run.mp4"):
        assert main(["render", str(path), str(tmp_path / name)]) == 0
    force = np.linalg.norm(read_recording(path).ticks["wrench_on_tool"][:, :3], axis=1)
    assert 0 < force.argmax() < len(force) - 1
    assert shots[0].at == pytest.approx(1e-3 * (force.argmax() + 1))
    assert shots[1].at is None
