"""``hapticbridge guide``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.markdown import Markdown

from hapticbridge.arguments import option
from hapticbridge.cli.terminal import out
from hapticbridge.errors import HapticBridgeError, choices, nearest

FOLDER = Path(__file__).parent.parent / "guide"
"""Folder of the pages, one Markdown file each, named after its topic."""

TOPICS = {
    "Tutorials": ("first-run", "own-scene", "own-loop", "own-device", "audit-in-ci"),
    "How to": (
        "devices",
        "device-package",
        "stiff-device",
        "coupling",
        "active-verdict",
        "missed-deadlines",
        "shaking-scene",
        "many-recordings",
        "other-programs",
    ),
    "Explanation": (
        "passivity",
        "force-level",
        "rigid-contact",
        "slower-scenes",
        "faults",
        "audit",
    ),
    "Reference": ("examples", "recording-format", "recordings-from-others", "mjcf", "glossary"),
}
"""Topics of the guide by kind, in the order of reading."""

WIDTH = 100
"""Largest width of a page in columns. Longer lines of prose are hard to read."""


def page(topic: str) -> str:
    """Returns the Markdown text of a topic.

    Raises:
        HapticBridgeError: There is no such topic.
    """
    topics = [name for names in TOPICS.values() for name in names]
    if topic in topics:
        return (FOLDER / f"{topic.replace('-', '_')}.md").read_text(encoding="utf-8")
    advice = nearest(topic, topics).rstrip()
    if not advice:
        found = [name for name in topics if topic.lower() in page(name).lower()]
        headed = [name for name in found if any(topic.lower() in h.lower() for h in headings(name))]
        lead = "the word is in" if topic and found else "choose one of"
        lead = "the word is explained in" if topic and headed else lead
        advice = f"{lead} {choices(headed or found or topics)}"
    raise HapticBridgeError(f"the guide has no topic '{topic}'; {advice}")


def headings(topic: str) -> list[str]:
    """Returns the headings of a page, and the words of the glossary."""
    lines = page(topic).splitlines()
    words = [line.split("|")[1] for line in lines if line.startswith("|") and topic == "glossary"]
    return [line.lstrip("# ") for line in lines if line.startswith("#")] + words


@dataclass(frozen=True, slots=True)
class Guide:
    """Read how to do something, and why it works.

    A pipe or a file gets the page as Markdown.

    Example:
        hapticbridge guide first-run
    """

    topic: str | None = option(None, metavar="TOPIC", is_positional=True)
    """Topic of the page; without one, the topics are listed."""

    def execute(self) -> int:
        """Prints the page or the list; returns the exit code."""
        if self.topic is None:
            for kind, names in TOPICS.items():
                out.print(f"[bold]{kind}[/bold]")
                for name in names:
                    title = page(name).partition("\n")[0].removeprefix("# ")
                    out.print(f"  {name:<24}{title}")
            out.print("next: hapticbridge guide TOPIC")
        elif out.is_terminal:
            out.print(Markdown(page(self.topic)), width=min(out.width, WIDTH), soft_wrap=False)
        else:
            print(page(self.topic), end="")
        return 0
