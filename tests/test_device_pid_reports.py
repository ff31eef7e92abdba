"""PID reports against the table that made the descriptor."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping

import pytest
from device_benches import LAYOUTS, MOUSE
from device_benches import opened_stick as opened
from emulated.pid_layouts import OUT, PID, Part, Report, descriptor
from emulated.pid_model import PidStick
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.pid import reports as wire
from hapticbridge.device.pid.device import Stick
from hapticbridge.device.pid.reports import PidReports, has_force_feedback
from hapticbridge.device.transport.hid_descriptor import Layout
from hapticbridge.errors import DeviceError

JOYSTICK = bytes.fromhex("0501 0904 a101 0930 0931 1581 257f 7508 9502 8102 c0")
"""Two axes and no force."""


def changed(name: str, part: str, **change: object) -> dict[str, Report]:
    """Returns the usual layout with one part of one report changed."""
    layout = dict(LAYOUTS["usual"])
    parts = tuple(
        dataclasses.replace(one, **change) if one.name == part else one  # type: ignore[arg-type]
        for one in layout[name].parts
    )
    layout[name] = dataclasses.replace(layout[name], parts=parts)
    return layout


def without(*names: str) -> dict[str, Report]:
    return {name: report for name, report in LAYOUTS["usual"].items() if name not in names}


def undirected() -> dict[str, Report]:
    effect = LAYOUTS["usual"]["effect"]
    parts = tuple(part for part in effect.parts if part.within != PID | 0x57)
    return {**LAYOUTS["usual"], "effect": dataclasses.replace(effect, parts=parts)}


@pytest.fixture(params=LAYOUTS, name="layout")
def _layout(request: pytest.FixtureRequest) -> Mapping[str, Report]:
    return LAYOUTS[request.param]


def said(layout: Mapping[str, Report], name: str, report: bytes | None) -> dict[str, int]:
    """Returns what the model's table reads from a report of the driver; it must be that one."""
    assert report is not None
    assert (report[0], len(report)) == (layout[name].number, layout[name].length)
    return layout[name].unpacked(report)


def test_each_report_says_what_it_should_in_the_tables_words(layout: Mapping[str, Report]) -> None:
    reports = PidReports(Layout(descriptor(layout.values())))
    for usage in (wire.ENABLE, wire.DISABLE, wire.STOP_ALL, wire.RESET):
        value = said(layout, "control", reports.control(usage))["control"]
        assert layout["control"].chosen("control", value) == usage & 0xFFFF
    gain = layout["gain"].part("gain").high
    assert said(layout, "gain", reports.full_gain())["gain"] == gain
    kind = said(layout, "create", reports.create())["type"]
    assert layout["create"].chosen("type", kind) == 0x26
    for usage in (wire.START, wire.STOP):
        values = said(layout, "operation", reports.operate(7, usage))
        assert layout["operation"].chosen("operation", values["operation"]) == usage & 0xFFFF
        assert (values["index"], values["loops"]) == (7, 1)
    assert said(layout, "free", reports.free(9))["index"] == 9


def test_an_effect_is_described_in_the_devices_own_units(layout: Mapping[str, Report]) -> None:
    reports = PidReports(Layout(descriptor(layout.values())))
    part = layout["effect"].part
    values = said(layout, "effect", reports.set_effect(3, 270.0, 0.1))
    assert values["index"] == 3
    assert values["duration"] * 10.0 ** part("duration").unit[1] == pytest.approx(0.1)
    assert values["direction"] == round(0.75 * (part("direction").high + 1))
    assert (values["gain"], values["by_direction"]) == (part("gain").high, 1)
    assert layout["effect"].chosen("type", values["type"]) == 0x26
    assert (values["delay"], values["trigger"], values["trigger_repeat"]) == (0, 0, 0)
    # all ones is 'for ever' with many devices; no finite duration comes to that
    longest = said(layout, "effect", reports.set_effect(3, 0.0, 1e9))["duration"]
    assert longest == part("duration").high
    assert reports.longest() < part("duration").high * 10.0 ** part("duration").unit[1]


@given(st.floats(-1.0, 1.0))
def test_a_force_arrives_within_half_a_count(share: float) -> None:
    for layout in LAYOUTS.values():
        magnitude = PidReports(Layout(descriptor(layout.values()))).magnitude(5)
        values = said(layout, "force", magnitude.report(round(share * magnitude.full)))
        full = layout["force"].part("magnitude").high
        assert values["magnitude"] == pytest.approx(share * full, abs=0.5)
        assert values["index"] == 5


@pytest.mark.parametrize(("usage", "is_there"), [(0x8C, True), (0x8D, False), (0x8E, False)])
def test_block_load_is_read_back(layout: Mapping[str, Report], usage: int, is_there: bool) -> None:
    reports = PidReports(Layout(descriptor(layout.values())))
    part = layout["load"].part("status")
    status = part.low + part.choices.index(PID | usage)
    answer = layout["load"].packed(index=4, status=status, memory=9)
    assert reports.load == (layout["load"].number, layout["load"].length)
    assert reports.loaded(answer) == (PID | usage, 4)
    assert (reports.loaded(answer)[0] == wire.LOADED) is is_there
    assert reports.loaded(layout["load"].packed(index=4, status=0))[0] is None
    assert wire.FULL == PID | 0x8D
    assert reports.max_effects(layout["pool"].packed(most=2)) == 2
    assert reports.max_effects(layout["pool"].packed(most=0)) is None


def test_flags_do_for_choices_where_a_device_has_flags() -> None:
    layout = dict(LAYOUTS["usual"])
    usages = (0x97, 0x98, 0x99, 0x9A)
    flags = tuple(Part(f"u{usage:x}", PID | usage, 1, 0, 1, PID | 0x96) for usage in usages)
    layout["control"] = Report(kind=OUT, number=12, usage=PID | 0x95, parts=flags)
    reports = PidReports(Layout(descriptor(layout.values())))
    for usage in usages:
        values = said(layout, "control", reports.control(PID | usage))
        assert [name for name, value in values.items() if value] == [f"u{usage:x}"]


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (without("effect"), "its reports lack SetEffect"),
        (without("force"), "its reports lack SetConstantForce"),
        (without("operation"), "its reports lack EffectOperation"),
        (without("control"), "its reports lack DeviceControl"),
        (without("create"), "its reports lack CreateNewEffect"),
        (without("load"), "its reports lack BlockLoad"),
        (changed("effect", "duration", usage=PID | 0x1), "lack a duration"),
        (undirected(), "its reports lack a direction"),
        (changed("effect", "by_direction", usage=PID | 0x1), "lack DirectionEnable"),
        (changed("effect", "duration", high=0), "its durations have no range"),
        (changed("force", "magnitude", usage=PID | 0x1), "lack a magnitude"),
        (changed("force", "magnitude", low=0), "goes from 0 to 32767: it has no sign"),
        (changed("create", "type", choices=(PID | 0x40,)), "its reports lack constant force"),
        (changed("operation", "operation", choices=(PID | 0x79,)), "that stops an effect"),
        (changed("state", "x", usage=0x10036), "its reports lack an X axis"),
        (
            changed("state", "y", usage=0x10036),
            "lack a Y axis; a device of one axis, such as a wheel, is '--device wheel'",
        ),
        (changed("state", "x", low=5, high=5), "its axes have no range"),
        (
            changed("effect", "enable_y", usage=PID | 0x1),
            "on both X and Y; a device of one axis, such as a wheel, is '--device wheel'",
        ),
    ],
)
def test_device_lacking_reports_is_refused(layout: dict[str, Report], words: str) -> None:
    with pytest.raises(DeviceError, match=re.escape(words)) as refused:
        opened(PidStick(layout=layout))
    assert str(refused.value).startswith("PID test stick (1209:4801, serial P1) cannot be driven: ")
    assert "\n" not in str(refused.value)


def test_what_a_device_may_lack_is_not_missed() -> None:
    reports = PidReports(Layout(descriptor(without("gain", "free", "pool").values())))
    assert (reports.full_gain(), reports.free(1), reports.pool) == (None, None, None)


def test_a_stick_is_known_by_its_usages_and_a_joystick_without_force_is_none() -> None:
    for layout in LAYOUTS.values():
        assert has_force_feedback(descriptor(layout.values()))
    assert not has_force_feedback(JOYSTICK)
    assert not has_force_feedback(b"")
    with pytest.raises(DeviceError, match=r"no device 'pid' is plugged in \(looked for any"):
        model = PidStick()
        model.report_descriptor = JOYSTICK
        opened(model)


@given(st.integers(0, 2000), st.binary(max_size=6), st.sampled_from(sorted(LAYOUTS)), st.booleans())
def test_spoilt_descriptor_is_safe(place: int, spoilt: bytes, name: str, is_inserted: bool) -> None:
    raw = descriptor(LAYOUTS[name].values())
    place %= len(raw)
    after = raw[place + (0 if is_inserted else len(spoilt)) :]
    raw = raw[:place] + spoilt + after
    try:
        layout = Layout(raw)
        reports, stick = PidReports(layout), Stick(layout)
        effect = reports.set_effect(1, 90.0, 0.1)
        stick.takes(bytes(64))
        reports.loaded(bytes(8))
    except DeviceError as error:
        assert "\n" not in str(error)
    else:
        assert len(effect) > 1
        assert len(reports.magnitude(1).report(-reports.magnitude(1).full)) > 1


def test_a_mouse_beside_the_stick_is_not_taken_for_it() -> None:
    numbered = MOUSE[:6] + b"\x85\x70" + MOUSE[6:]
    layout = Layout(numbered + descriptor(LAYOUTS["usual"].values()))
    stick = Stick(layout)
    assert not stick.takes(b"\x70\x00\x7f\x7f")
    assert stick.deflection == [0.0, 0.0]
    state = LAYOUTS["usual"]["state"]
    assert stick.takes(state.packed(x=32767, y=-32767, button3=1))
    assert (stick.deflection, stick.buttons) == ([1.0, -1.0], 0b100)


@given(st.lists(st.binary(max_size=24), max_size=5), st.sampled_from(sorted(LAYOUTS)))
def test_any_report_keeps_the_stick_within_stops(reports: list[bytes], name: str) -> None:
    layout = LAYOUTS[name]
    stick = Stick(Layout(descriptor(layout.values())))
    for report in reports:
        is_whole = len(report) >= layout["state"].length and report[0] == layout["state"].number
        assert stick.takes(report) == is_whole
        assert max(abs(value) for value in stick.deflection) <= 1.0
        assert 0 <= stick.buttons < 256
