"""What a chart leaves in its folder: pictures, page, table and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.picture import write_picture
from hapticbridge.provenance import versions
from hapticbridge.study.chart.chart import Chart
from hapticbridge.study.chart.drawing import draw_chart
from hapticbridge.study.chart.page import chart_page
from hapticbridge.study.chart.recommendation import recommendation

ENDINGS = ("png", "svg", "csv", "json", "html")


@dataclass(frozen=True, slots=True)
class ChartFiles:
    """Paths by ending, and what the chart says.

    Attributes:
        paths: By ending, of ``ENDINGS``.
        said: What is in the JSON file.
    """

    paths: Mapping[str, Path]
    said: Mapping[str, Any]


def prepared_files(folder: Path, name: str) -> dict[str, Path]:
    """Makes the folder and proves that every file can be written, before anything is computed.

    Raises:
        StudyError: It cannot, or a scene of this name lies there, whose hand path is ``NAME.csv``.
    """
    if (folder / f"{name}.xml").exists():
        raise StudyError(
            f"'{folder}' holds the scene {name}.xml, and its hand path {name}.csv would be "
            "overwritten; name another folder"
        )
    paths = {ending: folder / f"{name}.{ending}" for ending in ENDINGS}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in paths.values():
            is_new = not path.exists()
            with path.open("ab"):
                pass
            if is_new:
                path.unlink()
    except FileExistsError:
        raise StudyError(f"'{folder}' is a file; name a folder to write into") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise StudyError(f"cannot write into '{folder}': {reason}") from None
    return paths


def write_chart(chart: Chart, paths: Mapping[str, Path]) -> ChartFiles:
    """Writes everything.

    Args:
        chart: What was measured.
        paths: By ending, as ``prepared_files`` returned them.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    said = summary_of(chart)
    texts = {
        "csv": table_of(chart),  # first: it is what cost the time
        "json": json.dumps(said, indent=2, allow_nan=False) + "\n",
        "html": chart_page(chart),
    }
    for ending, text in texts.items():
        try:
            paths[ending].write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise StudyError(f"cannot write '{paths[ending]}': {error.strerror}") from None
    figure = draw_chart(chart)
    write_picture(figure, paths["png"])
    write_picture(figure, paths["svg"])
    return ChartFiles(dict(paths), said)


def table_of(chart: Chart) -> str:
    """Returns a CSV text: a row per point and panel, every setting in it."""
    fronts = {
        panel.key: {id(each) for each in chart.front(panel)} for panel in chart.workload.panels
    }
    rows = [
        each.cells(chart.workload.name, chart.workload.coupling)
        | {"on_front": int(id(each) in fronts[each.panel]), "machine": chart.machine}
        for each in chart.measurements
    ]
    text = io.StringIO()
    # other engines have a column of their own
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def summary_of(chart: Chart) -> dict[str, Any]:
    """Returns what the chart says, for JSON: numbers that are not finite become None."""
    panels = [
        {
            "panel": panel.key,
            "title": panel.title,
            "reference": panel.reference,
            "reference_is_truth": panel.is_truth,
            "recommendation": recommendation(
                chart.of(panel), chart.machine, is_truth=panel.is_truth
            ),
            "front": [each.setting.label for each in chart.front(panel)],
            "convergence_orders": chart.orders(panel),
        }
        for panel in chart.workload.panels
    ]
    points = [
        each.cells(chart.workload.name, chart.workload.coupling) for each in chart.measurements
    ]
    said = {
        "workload": chart.workload.name,
        "about": chart.workload.about,
        "machine": chart.machine,
        "versions": versions(),
        "baseline": chart.baseline,
        "notes": list(chart.notes),
        "skipped": chart.skipped,
        "engines": {
            name: {
                "version": engine.version,
                "settings": {key: each._asdict() for key, each in engine.settings.items()},
            }
            for name, engine in chart.engines.items()
        },
        "panels": panels,
        "points": points,
    }
    known: dict[str, Any] = _known(said)
    return known


def _known(value: Any) -> Any:
    """Returns a value for JSON, which knows neither NaN nor infinity."""
    if isinstance(value, Mapping):
        return {key: _known(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_known(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
