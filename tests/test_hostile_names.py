"""Script in every name of a scene, of a device and of files: pages show it, and none runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any

import pytest
from audit_cases import ScriptedDevice, recorded, rewritten
from chromium import Tab, browser
from report_runs import LOOSE
from view_cases import AT_ONCE, pressed

from hapticbridge.audit import audit
from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.recording import read_recording
from hapticbridge.report import write_report
from hapticbridge.scene import load_scene
from hapticbridge.whatif import what_if, write_what_if

FILE = "<img src=x onerror=ran=1><svg onload=ran=2>"
"""Script in the name of a file, which has no slash."""

EVIL = (
    FILE + "\"'`${ran=3}</title></style></script><script>ran=4</script>"
    '[x](javascript:ran=5)![x](x"onerror=ran=6) {ran=7} **bold** <b class=evil>'
)
"""Script for HTML, attributes, templates, Markdown and MDX."""

NAME = escape(EVIL).replace("{", "&#123;")

SCENE = f"""<mujoco model="{NAME}">
  <!-- {NAME} -->
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0"/>
  <statistic center="0 0 0" extent="0.2"/>
  <custom><text name="{NAME}" data="{NAME}"/><numeric name="{NAME}" data="1"/></custom>
  <asset><material name="{NAME}" rgba="1 0 0 1"/></asset>
  <worldbody>
    <light name="{NAME}" pos="0 0 1"/>
    <camera name="{NAME}" pos="0 0 1"/>
    <geom name="{NAME} floor" type="plane" size="0.1 0.1 0.01"/>
    <body name="{NAME} ball" pos="0 0 0.03">
      <freejoint name="{NAME}"/>
      <geom name="{NAME}" type="sphere" size="0.02" mass="0.1" material="{NAME}"/>
      <site name="{NAME}"/>
    </body>
    <body name="{NAME} arm" pos="0 0.1 0.1">
      <joint name="{NAME} arm" type="slide" damping="1"/>
      <geom name="{NAME} arm" size="0.01" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><motor name="{NAME}" joint="{NAME} arm"/></actuator>
  <sensor><jointpos name="{NAME}" joint="{NAME} arm"/></sensor>
  <keyframe>
    <key name="home" qpos="0 0 0.03 1 0 0 0 0"/><key name="{NAME}" qpos="0 0 0.03 1 0 0 0 0"/>
  </keyframe>
</mujoco>"""

IS_UNHARMED = """(() => {
    const sources = [...document.scripts].every(each => each.nonce);
    const marks = 'img[src=x], svg[onload], [onerror], [onload], a[href^=javascript], .evil';
    return window.ran === undefined && sources && document.querySelector(marks) === null;
})()"""
"""True in a page where no foreign script ran and no foreign element was made."""

TRY = """(async () => {
    const html = "<img src=x onerror='window.ran=8'><iframe srcdoc='<script>top.ran=9</script>'>";
    document.body.insertAdjacentHTML('beforeend', html);
    const own = document.createElement('script');
    own.textContent = 'window.ran=10';
    document.body.append(own);
    await new Promise(done => setTimeout(done, 500));
    return window.ran === undefined;
})()"""
"""True in a page whose policy stops script that was not escaped."""


@pytest.fixture(scope="module")
def evil(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in whose scene, device and files every name is script."""
    folder = tmp_path_factory.mktemp("evil") / FILE
    folder.mkdir()
    (folder / f"{FILE}.xml").write_text(SCENE)
    scene = load_scene(folder / f"{FILE}.xml", grip=EVIL)
    device = ScriptedDevice(pressed, name=EVIL)
    path = folder / f"{FILE}.mcap"
    recorded(path, scene, device, LOOSE, duration=0.3, limits=AT_ONCE)
    return path


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], Tab]]:
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def report_of(path: Path, page: Path) -> None:
    write_report(read_recording(path), audit(path), page)


def report_of_edited(path: Path, page: Path) -> None:
    """Writes the report on a file whose metadata and events are script, too."""
    recording = read_recording(path)
    meta = {key: EVIL for key in recording.meta if key not in ("format", "epoch_ns", "period_s")}
    trip = {"event": "trip", "tick": 9, "time_ns": 0, "reason": EVIL, EVIL: EVIL, "by": EVIL}
    edited = rewritten(
        recording, page.with_suffix(".mcap"), meta=meta, events=[*recording.events, trip]
    )
    report_of(edited, page)


def report_of_a_trip(path: Path, page: Path) -> None:
    recording = read_recording(path)
    trip = {"event": "trip", "tick": 299, "time_ns": 0}
    trip |= Trip(TripCode.DEVICE, 299, detail=EVIL).details()
    edited = rewritten(recording, page.with_suffix(".mcap"), events=[*recording.events, trip])
    report_of(edited, page)


def page_of_what_if(path: Path, page: Path) -> None:
    write_what_if(what_if(path, {"stiffness": 600}), page)


@pytest.mark.parametrize("write", [report_of, report_of_edited, report_of_a_trip, page_of_what_if])
def test_no_name_runs_script_in_a_page_on_disk(
    write: Callable[[Path, Path], None], evil: Path, tmp_path: Path, tab: Callable[[], Tab]
) -> None:
    page, shown = tmp_path / "page.html", tab()
    write(evil, page)
    shown.open(page.as_uri())
    assert shown.value(IS_UNHARMED)
    assert shown.value("document.scripts.length") == 0
    assert shown.value("document.body.innerText").count("onerror=ran=1") >= 1  # but it is shown
    assert [each for each in shown.requests if not each.startswith("data:")] == [page.as_uri()]
    assert shown.value(TRY)


def test_no_name_runs_script_in_the_view(evil: Path, tab: Callable[[], Tab]) -> None:
    pytest.importorskip("viser", reason="needs the extra 'view'")
    from hapticbridge.view.page import quoted
    from hapticbridge.view.replay import Replay, Theatre
    from hapticbridge.view.server import serve, stop
    from hapticbridge.view.window import Address

    theatre, shown = Theatre(Replay(evil), Address(0)), tab()
    try:
        shown.open(theatre.url)
        shown.wait_for("document.body.innerText.includes('on the tool')")
        shown.wait_for("document.body.innerText.includes('onerror=ran=1')")  # its label
        assert shown.value("location.href") == theatre.url.partition("?")[0]
        assert shown.value(IS_UNHARMED)
        assert shown.value(TRY)
    finally:
        theatre.close()
    server, shown = serve(address := Address(0)), tab()
    texts = [EVIL, f"`{EVIL}``", f"\n\n# {EVIL}\n\n```\n", "`", "``` ` ```"]
    try:
        for text in texts:
            server.gui.add_markdown(f"recording to {quoted(text)}.")
        shown.open(address.url(server.get_port()))
        shown.wait_for(f"document.querySelectorAll('code').length === {len(texts)}")
        seen: Any = shown.value("[...document.querySelectorAll('code')].map(e => e.textContent)")
        assert seen == [text.replace("\n", "�") for text in texts]
        assert shown.value(IS_UNHARMED)
    finally:
        stop(server)
