"""Every layout, in both byte orders, both ways."""

import pytest
from rtps import PREFIX, WRITER

from edoras_tools.addons.rtps.wire.headers import (
    BUILT_IN,
    EVERY_RTPS_LAYOUT,
    RTPS_HEADER,
    SUBMESSAGE_LAYOUTS,
    SubmessageKind,
)


def test_a_real_header():
    raw = b"RTPS\x02\x05\x01\x10" + PREFIX
    values = {
        "magic": 0x52545053,
        "version_major": 2,
        "version_minor": 5,
        "vendor_id": 0x0110,
        "guid_prefix": PREFIX,
    }
    assert RTPS_HEADER.parse(raw) == values
    assert RTPS_HEADER.emit(values) == raw


@pytest.mark.parametrize("kind", SUBMESSAGE_LAYOUTS)
def test_both_orders_hold_the_same(kind):
    little, big = SUBMESSAGE_LAYOUTS[kind]
    values = {
        slot.field.name: WRITER[: slot.end - slot.start].ljust(slot.end - slot.start, b"\1")
        if slot.field.kind == "bytes"
        else 1 + place
        for place, slot in enumerate(little.slots)
    }
    assert little.size == big.size
    assert little.parse(little.emit(values)) == values == big.parse(big.emit(values))
    if kind != SubmessageKind.INFO_DST:
        assert little.emit(values) != big.emit(values)


def test_names_are_unique():
    names = [layout.name for layout in EVERY_RTPS_LAYOUT]
    assert len(set(names)) == len(names)
    assert all(len(item) == 4 and item[-1] & 0xC0 == 0xC0 for item in BUILT_IN)
