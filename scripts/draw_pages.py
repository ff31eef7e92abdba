"""Takes the pictures of the pages that the guide shows, in a headless Chromium.

    python scripts/draw_pages.py RECORDING ACTIVE_RECORDING FOLDER

writes FOLDER/view.png, the view of the first recording, and FOLDER/report.png, the head of the
report on the second, which should be active.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from chromium import Tab, browser  # noqa: E402 - beside the tests that use it, too

from hapticbridge.audit import audit  # noqa: E402
from hapticbridge.recording import read_recording  # noqa: E402
from hapticbridge.replay.film import Shot, still  # noqa: E402
from hapticbridge.report import telling_time, write_report  # noqa: E402
from hapticbridge.view import Address  # noqa: E402
from hapticbridge.view.replay import Replay, Theatre  # noqa: E402

WIDTH = 800
"""Size of a picture in pixels. Pages are drawn larger and then reduced, so that all of it fits."""

SETTLED = 60.0
"""Time in s until a page without a graphics card has drawn its content. On a busy machine its
colours are pale after 15 s."""


def save(tab: Tab, target: Path) -> None:
    """Writes the content of a tab."""
    with tempfile.TemporaryDirectory() as folder:
        tab.picture(Path(folder) / "page.png")
        image = Image.open(io.BytesIO((Path(folder) / "page.png").read_bytes())).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    image = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    # in 256 colours a floor has steps, or thin curves another colour
    image.save(target, optimize=True)


def draw_view(tab: Tab, file: Path, target: Path) -> None:
    """Draws the view of a recording at its largest force."""
    replay = Replay(file)
    theatre = Theatre(replay, Address(0))
    moment = telling_time(read_recording(file), audit(file))
    tab.open(theatre.url, 1200, 900)
    tab.wait_for("document.querySelectorAll('canvas').length >= 5")
    theatre.slider.value = round(moment, 3)
    theatre.show(moment)
    time.sleep(SETTLED)
    # a warning of viser's that there is no graphics card here
    tab.value("document.querySelectorAll('[class*=Notification]').forEach(n => n.remove())")
    save(tab, target)
    theatre.close()


def draw_report(tab: Tab, file: Path, target: Path) -> None:
    """Draws the head of the report on a recording."""
    report, recording = audit(file), read_recording(file)
    page = target.with_name("report.html").resolve()
    shot = Shot(at=telling_time(recording, report), width=640, height=400)
    write_report(recording, report, page, still(file, shot))
    tab.open(page.as_uri(), 1000, 1040)
    time.sleep(1.0)
    save(tab, target)
    page.unlink()


def main(arguments: list[str]) -> int:
    """Draws both; returns the exit code."""
    recording, active, folder = map(Path, arguments)
    with tempfile.TemporaryDirectory() as scratch, browser(Path(scratch)) as tab:
        draw_report(tab(), active, folder / "report.png")
        draw_view(tab(), recording, folder / "view.png")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
