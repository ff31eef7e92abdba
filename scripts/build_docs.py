"""Builds the documentation's site with Sphinx; ``scripts/docs`` installs what it needs first.

The pages are those of ``hapticbridge guide``, of the scenes in ``models`` and the help texts of the
commands. The reference of the Python interface comes from the docstrings. A link to a page or a
heading that does not exist is an error.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
from pathlib import Path

from hapticbridge.cli.guide import FOLDER, TOPICS
from hapticbridge.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[1]
SOURCE, SITE = ROOT / "build/docs/source", ROOT / "build/docs/site"

CONFIGURATION = """
project = "hapticbridge"
author = "The hapticbridge maintainers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
html_theme = "furo"
html_title = "hapticbridge"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
napoleon_use_ivar = True
myst_heading_anchors = 3
highlight_language = "none"
suppress_warnings = ["ref.python"]
"""

INTERFACE = {
    "Run": (
        "run.bridge.Bridge",
        "run.options.BridgeOptions",
        "run.options.Workspace",
        "demand.guard.Limits",
    ),
    "Result": ("run.summary.Summary", "audit.audit", "audit.verdict.AuditReport"),
    "Scene and coupling": ("scene.load.load_scene", "scene.scene.Scene", "coupling.Coupling"),
    "Device": (
        "device.base.Device",
        "device.base.DeviceInfo",
        "device.registry.open_device",
        "kernel.record.TickFlag",
    ),
    "Clock": ("clock.RealClock", "clock.SimulatedClock"),
    "Recording": (
        "recording.reader.read_recording",
        "recording.reader.Recording",
        "recording.writer.repair",
        "tools.export.export",
    ),
    "Changes during a run": ("run.commands.Couple", "run.commands.Switch"),
    "Many runs": ("sweep.sweep", "sweep.grid", "sweep.Table"),
    "Errors": (
        "errors.HapticBridgeError",
        "errors.SafetyTrip",
        "errors.SceneError",
        "errors.DeviceError",
        "errors.RecordingError",
    ),
}
"""Classes and functions of the reference by subject, below ``hapticbridge``."""


def toctree(caption: str, names: list[str]) -> str:
    """Returns a list of pages for a page's navigation."""
    lines = "\n".join(names)
    return f"```{{toctree}}\n:caption: {caption}\n:hidden:\n\n{lines}\n```\n"


def directive(name: str) -> str:
    """Returns the lines that print the docstring of a class or function."""
    is_class = name.rpartition(".")[2][0].isupper()
    members = "   :members:\n" if is_class else ""
    return f".. auto{'class' if is_class else 'function'}:: hapticbridge.{name}\n{members}\n"


def heading(title: str, line: str) -> str:
    """Returns a heading of reStructuredText."""
    return f"{title}\n{line * len(title)}\n\n"


def help_of(command: str) -> str:
    """Returns all options of a command."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([command, "--help-all"])
    return text.getvalue()


def write_pages() -> None:
    """Writes the sources of all pages."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(FOLDER, SOURCE / "guide")
    (SOURCE / "conf.py").write_text(CONFIGURATION, encoding="utf-8")
    scenes = sorted(path.parent.name for path in (ROOT / "models").glob("*/README.md"))
    for scene in scenes:
        (SOURCE / "scenes" / scene).mkdir(parents=True)
        shutil.copy(ROOT / "models" / scene / "README.md", SOURCE / "scenes" / scene / "index.md")
        for picture in (ROOT / "models" / scene).glob("*.png"):
            shutil.copy(picture, SOURCE / "scenes" / scene)
    shutil.copytree(ROOT / "scripts/figures", SOURCE / "scripts/figures")
    reference = [heading("Python interface", "=")]
    for subject, names in INTERFACE.items():
        reference += [heading(subject, "-"), *map(directive, names)]
    (SOURCE / "python.rst").write_text("".join(reference), encoding="utf-8")
    commands = [f"## {name}\n```text\n{help_of(name)}```\n" for name in COMMANDS]
    (SOURCE / "commands.md").write_text("# Commands\n" + "\n".join(commands), encoding="utf-8")
    contents = [
        toctree(kind, [f"guide/{topic.replace('-', '_')}" for topic in topics])
        for kind, topics in TOPICS.items()
    ]
    contents += [
        toctree("Interface", ["commands", "python"]),
        toctree("Scenes", [f"scenes/{scene}/index" for scene in scenes]),
    ]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (SOURCE / "index.md").write_text(readme + "\n" + "\n".join(contents), encoding="utf-8")


def build() -> int:
    """Writes the pages and builds the site; returns Sphinx's exit code."""
    from sphinx.cmd.build import build_main  # noqa: PLC0415 - of the extra 'docs'

    os.environ["COLUMNS"] = "100"
    write_pages()
    code = int(build_main(["-q", "-W", "--keep-going", str(SOURCE), str(SITE)]))
    if code == 0:
        print(f"wrote {SITE / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(build())
