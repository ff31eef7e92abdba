"""What a chart leaves in its folder: pictures, page, table and JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from hapticbridge.errors import StudyError
from hapticbridge.files import finite_or_null
from hapticbridge.plotting import write_picture
from hapticbridge.run_description import versions
from hapticbridge.study.chart.chart import Chart
from hapticbridge.study.chart.drawing import draw_chart
from hapticbridge.study.chart.page import chart_page
from hapticbridge.study.chart.recommendation import recommendation
from hapticbridge.study.folder import prepared_folder

PICTURES = ("png", "svg")
ENDINGS = (*PICTURES, "csv", "json", "html")


@dataclass(frozen=True, slots=True)
class ChartFiles:
    """Paths by ending, and what the chart says.

    Attributes:
        paths: By ending, of ``ENDINGS``.
        said: What is in the JSON file.
    """

    paths: Mapping[str, Path]
    said: Mapping[str, Any]


def prepared_files(folder: Path, name: str, endings: Sequence[str] = ENDINGS) -> dict[str, Path]:
    """Makes the folder and proves that every file can be written, before anything is computed.

    Args:
        folder: To write into.
        name: Of the files, without ending.
        endings: Of the files.

    Raises:
        StudyError: It cannot, or a scene of this name lies there, whose hand path is ``NAME.csv``.
    """
    if (folder / f"{name}.xml").exists():
        raise StudyError(
            f"'{folder}' holds the scene {name}.xml, and its hand path {name}.csv would be "
            "overwritten; name another folder"
        )
    files = {ending: f"{name}.{ending}" for ending in endings}
    prepared_folder(folder, files.values())
    return {ending: folder / file for ending, file in files.items()}


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
    write_files(paths, texts, draw_chart(chart))
    return ChartFiles(dict(paths), said)


def write_files(paths: Mapping[str, Path], texts: Mapping[str, str], figure: Figure) -> None:
    """Writes texts by ending, in their order, and then the picture as PNG and SVG.

    Raises:
        HapticBridgeError: A file cannot be written.
    """
    for ending, text in texts.items():
        try:
            paths[ending].write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise StudyError(f"cannot write '{paths[ending]}': {error.strerror}") from None
    for ending in PICTURES:
        write_picture(figure, paths[ending])


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Returns rows as CSV with a header; a row that lacks a column leaves it empty."""
    text = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


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
    return csv_text(rows)


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
            "front": [
                {
                    "setting": each.setting.label,
                    "cost": each.cost.median,
                    "error": each.score.felt,
                    "verdict": each.score.verdict,
                }
                for each in chart.front(panel)
            ],
            "convergence_orders": {
                name: asdict(order) | {"is_settled": order.is_settled}
                for name, order in chart.orders(panel).items()
            },
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
    found: dict[str, Any] = finite_or_null(said)
    return found
