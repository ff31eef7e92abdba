"""The page of a chart stands alone and is well formed; its picture explains itself."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from chart_cases import made_up, small_chart

from hapticbridge.lab.chart import Chart
from hapticbridge.lab.chart.chart import Measurement
from hapticbridge.lab.chart.output import chart_page, draw_chart


@pytest.fixture(scope="module")
def chart() -> Chart:
    """A chart on which one point has diverged."""
    return small_chart()


class Page(HTMLParser):
    """Reads a page: which elements it has, and whether each is closed in its turn."""

    VOID = ("meta", "br", "link", "img", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes an element."""
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes an element without content."""
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        """Checks that the innermost open element is the one that ends."""
        assert self._open.pop() == tag


def check_page(text: str, *, spots: int) -> Page:
    """Checks that a page is well formed, asks for nothing, and tells of every point."""
    page = Page(text)
    assert text.startswith("<!doctype html>")
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttp|WebSocket", text)
    asking = {"src", "href", "srcset", "data", "action", "poster", "xlink:href"}
    assert not [tag for tag, named in page.found if asking & set(named) or tag == "link"]
    told = [named["data-told"] for _, named in page.found if named.get("class") == "spot"]
    assert len(told) == spots
    assert all(each and "times the baseline" in each for each in told)
    names = {named.get("data-name") for _, named in page.found} - {None}
    assert {named["data-of"] for _, named in page.found if named.get("class") == "spot"} == names
    assert not [named for _, named in page.found if "nan" in " ".join(map(str, named.values()))]
    assert len(text) < 100_000
    return page


def test_page_is_well_formed_and_asks_for_no_other_file(chart: Chart) -> None:
    check_page(chart_page(chart), spots=6)


def test_page_without_a_front_or_with_points_that_are_not_comparable_is_well_formed(
    chart: Chart,
) -> None:
    created = [
        replace(each, score=replace(each.score, verdict="active")) for each in chart.measurements
    ]
    page = chart_page(replace(chart, measurements=tuple(created)))
    check_page(page, spots=6)
    assert "Nothing is on the front" in page
    apart = [replace(each, limit_apart=1e9) for each in chart.measurements]
    pale = check_page(chart_page(replace(chart, measurements=tuple(apart))), spots=6)
    marked = [named for _, named in pale.found if named.get("class") == "spot"]
    finite = sum(np.isfinite(each.score.felt) for each in chart.measurements)
    assert sum(named.get("opacity") == ".2" for named in marked) == finite
    assert draw_chart(replace(chart, measurements=tuple(apart))).axes


def test_picture_says_what_its_words_and_pale_points_mean(chart: Chart) -> None:
    def words(*points: Measurement) -> str:
        labelled = tuple(replace(each, panel=chart.workload.panels[0].key) for each in points)
        figure = draw_chart(replace(chart, measurements=labelled))
        legend = figure.axes[0].get_legend()
        assert legend is not None
        return " ".join(text.get_text() for text in legend.get_texts())

    steps = (2.5e-4, 5e-4, 1e-3)
    plain = words(*(made_up(1.0, p, period=p) for p in steps))
    assert "implicit (order 1.0)" in plain
    for told in ("not settled", "gain nothing", "not comparable", "lower edge"):
        assert told not in plain
    assert "smaller steps gain nothing" in words(*(made_up(1.0, 0.1, period=p) for p in steps))
    assert "not settled" in words(*(made_up(1.0, p**p, period=p) for p in (0.1, 0.4, 1.6)))
    apart = words(made_up(1.0, 0.1, limit_apart=0.34))
    assert "implicit (limit 0.34 off)" in apart
    assert "not comparable" in apart
    assert "at the lower edge: 0.0001 JND or less" in words(made_up(1.0, 1e-6))
