"""Results in a notebook."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import hapticbridge as hb

ASKED = "_repr_html_"
"""Method that notebooks ask a result for."""


class Seen(HTMLParser):
    """Collects the text of a page, and refuses tags that are open at its end."""

    def __init__(self, result: Any) -> None:
        super().__init__()
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(getattr(result, ASKED)())
        assert not self._open

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module", name="run")
def _run(tmp_path_factory: pytest.TempPathFactory) -> tuple[hb.Summary, Path]:
    path = tmp_path_factory.mktemp("runs") / "a<b>&.mcap"
    with hb.Bridge("virtual_wall", clock=hb.SimulatedClock(), recording=path) as bridge:
        return bridge.run(0.2), path


def test_a_summary_begins_with_its_verdict(run: tuple[hb.Summary, Path]) -> None:
    summary = run[0]
    first, *words = Seen(summary).words
    assert first == summary.headline == str(summary).splitlines()[0]
    text = " ".join(str(summary).split())
    assert all(" ".join(word.split()) in text for word in words)
    assert len(words) >= len(str(summary).splitlines()) - 1


def test_an_audit_and_a_recording_name_their_file(run: tuple[hb.Summary, Path]) -> None:
    path = run[1]
    assert Seen(hb.audit(path, in_process=True)).words[0] == "a<b>&.mcap: passive (strict)"
    words = Seen(hb.read_recording(path)).words
    assert words[0] == "a<b>&.mcap"
    assert "0.200 s, 200 ticks" in words
    assert words[words.index("scene") + 1] == "virtual_wall"


def test_a_recording_that_lost_its_metadata_has_no_time(
    run: tuple[hb.Summary, Path], tmp_path: Path
) -> None:
    data, path = bytearray(run[1].read_bytes()), tmp_path / "torn.mcap"
    data[9:17] = (1 << 63).to_bytes(8, "little")  # the length of the first record
    path.write_bytes(data)
    assert "200 ticks" in Seen(hb.read_recording(path)).words
    assert "0.200 s, 200 ticks" in Seen(hb.read_recording(run[1])).words
