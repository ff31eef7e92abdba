from __future__ import annotations

import re

import pytest
from device_benches import LAYOUTS, MOUSE
from emulated import pid_layouts as model
from emulated.pid_layouts import Report, descriptor
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device.transport import hid_descriptor as hid
from hapticbridge.device.transport.hid_descriptor import Layout, element, fields_of, place_of
from hapticbridge.errors import DeviceError

KINDS = {model.IN: hid.INPUT, model.OUT: hid.OUTPUT, model.FEATURE: hid.FEATURE}


def test_the_standards_own_mouse_is_read_as_the_standard_says() -> None:
    buttons, padding, axes = fields_of(MOUSE)
    assert (buttons.offset, buttons.size, buttons.count) == (0, 1, 3)
    assert buttons.usages == (0x90001, 0x90002, 0x90003)
    assert (padding.offset, padding.size, padding.usages) == (3, 5, ())
    assert (axes.offset, axes.size, axes.count, axes.usages) == (8, 8, 2, (0x10030, 0x10031))
    assert (axes.minimum, axes.maximum, axes.physical) == (-127, 127, (-127, 127))
    assert axes.collections == (0x10002, 0x10001)
    assert {field.report for field in (buttons, axes)} == {0}
    assert not Layout(MOUSE).is_numbered
    assert Layout(MOUSE).length(hid.INPUT, 0) == 1 + 3


def test_a_state_that_is_kept_comes_back_and_a_long_item_means_nothing() -> None:
    # 8 bits, kept; 16 bits; back to 8; a long item of three bytes between
    text = "0501 0930 1500 25ff 7508 9501 8102 a4 7510 0931 8102 b4 fe0301 aabbcc 0932 8102"
    places = [(one.offset, one.size) for one in fields_of(bytes.fromhex(text))]
    assert places == [(0, 8), (8, 16), (24, 8)]


@pytest.mark.parametrize(
    ("text", "exponent"), [("55fd", -3), ("550d", -3), ("5502", 2), ("55fe", -2), ("5500", 0)]
)
def test_an_exponent_has_four_bits_or_eight(text: str, exponent: int) -> None:
    (field,) = fields_of(bytes.fromhex(f"050f 0950 {text} 660310 7508 9501 9102"))
    assert (field.exponent, field.unit) == (exponent, 0x1003)


def test_the_upper_end_has_a_sign_only_where_the_lower_one_is_negative() -> None:
    for text, limits in (
        ("1500 25ff", (0, 255)),
        ("1580 25ff", (-128, -1)),
        ("160080 26ff7f", (-32768, 32767)),
        ("1500 27ffff0000", (0, 65535)),
    ):
        (field,) = fields_of(bytes.fromhex(f"0501 0930 {text} 7510 9501 8102"))
        assert (field.minimum, field.maximum) == limits


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_value_is_found_where_the_table_that_made_the_descriptor_has_it(name: str) -> None:
    layout = Layout(descriptor(LAYOUTS[name].values()))
    for report in LAYOUTS[name].values():
        kind = KINDS[report.kind]
        assert layout.length(kind, report.number) == report.length
        fields = [f for f in layout.fields if (f.kind, f.report) == (kind, report.number)]
        for part in report.parts:
            if not part.name:
                continue
            wanted = part.choices or (part.usage,)
            (field,) = [f for f in fields if f.usages == wanted]
            place = element(field, 0)
            high = report.packed(**{part.name: part.high})
            assert place.bits(part.high) | report.number == int.from_bytes(high, "little")
            low = int.from_bytes(report.packed(**{part.name: part.low}), "little")
            read = place.read(low), place.read(int.from_bytes(high, "little"))
            assert read == (part.low, part.high)


@given(st.data())
def test_a_value_that_is_written_is_read_back_and_nothing_else_moves(data: st.DataObject) -> None:
    reports = list(LAYOUTS["odd"].values())
    report: Report = data.draw(st.sampled_from(reports))
    parts = [part for part in report.parts if part.name and not part.choices]
    if not parts:
        return
    part = data.draw(st.sampled_from(parts))
    layout = Layout(descriptor(reports))
    key = (KINDS[report.kind], report.number)
    fields = [field for field in layout.fields if (field.kind, field.report) == key]
    place = place_of(fields, part.usage)
    assert place is not None
    value = data.draw(st.integers(part.low, part.high))
    others = data.draw(st.integers(0, 2 ** (8 * report.length) - 1))
    clean = others & ~(place.mask << place.offset)
    assert place.read(clean | place.bits(value)) == value
    assert place.bits(value) & ~(place.mask << place.offset) == 0
    assert place.bits(part.high + 1) == place.bits(part.high)
    assert place.bits(part.low - 1) == place.bits(part.low)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"", "a report descriptor has 0 bytes; it must have 1 to 4096"),
        (bytes(hid.MAX_DESCRIPTOR + 1), "a report descriptor has 4097 bytes"),
        (b"\x05", "ends within the item at byte 0"),
        (b"\x05\x01\x27\x01\x02", "ends within the item at byte 2"),
        (b"\xfe\x05", "ends within the item at byte 0"),
        (b"\xc0", "ends a collection that never began"),
        (b"\xb4", "restores a state that it never stored"),
        (b"\x77\xff\xff\xff\x7f\x95\x01\x81\x02", "has a report of 2147483647 bits"),
        (b"\x86\x00\x01\x75\x08\x95\x01\x81\x02", "has the report number 256"),
    ],
)
def test_what_is_no_descriptor_is_refused_in_one_sentence(raw: bytes, words: str) -> None:
    with pytest.raises(DeviceError, match=re.escape(words)):
        fields_of(raw)


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_fields_or_a_refusal(raw: bytes) -> None:
    try:
        fields = fields_of(raw)
    except DeviceError as error:
        assert "\n" not in str(error)
        return
    for field in fields:
        assert field.offset >= 0
        assert field.size > 0
        assert field.physical[0] <= field.physical[1] or field.minimum > field.maximum
