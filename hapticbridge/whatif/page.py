"""Page of a what-if: the recorded run beside the changed ones."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from hapticbridge.errors import RecordingError
from hapticbridge.picture import inline_svg
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.html import write_page
from hapticbridge.report.page import moment_of
from hapticbridge.report.panels import BINS
from hapticbridge.whatif.outcome import WhatIf, WhatIfRun
from hapticbridge.whatif.picture import figure_of
from hapticbridge.whatif.side_by_side import changes, rows, sentences


def write_what_if(found: WhatIf, path: Path, scene: bytes | None = None) -> None:
    """Writes one self-contained HTML page of less than 1 MB, for any length of run.

    ``scene`` is a PNG picture of the recorded scene, or None. An existing file is replaced.

    Raises:
        RecordingError: The page cannot be written, or not under this name.
    """
    try:
        drawn = inline_svg(figure_of(found, BINS))
    except RecordingError:  # a run that cannot be drawn still has a verdict
        drawn = ""
    write_page(
        path,
        "what_if.html",
        name=found.path.name,
        recording=str(found.path),
        changes=list(changes(found)),
        runs=[_run_facts(run) for run in found.runs],
        rows=list(rows(found)),
        notes=found.notes,
        drawn=drawn,
        scene=scene and base64.b64encode(scene).decode(),
    )


def _run_facts(run: WhatIfRun) -> dict[str, Any]:
    evidence, report = Evidence.of(run.recording), run.report
    return {
        "name": run.name,
        "report": report,
        "sentences": list(sentences(run)),
        "moment": evidence and moment_of(evidence, report),
    }
