"""Names in C, and places that do not follow from the types of a sheet alone; ``test_types`` has the rest."""

from __future__ import annotations

from contextlib import suppress

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.addons.databases.placement import (
    DataType,
    Placement,
    SheetError,
    c_name,
    parse_document,
    polynomial,
)
from edoras_tools.errors import ConfigError
from edoras_tools.structs.shapes import BASIC, OPEN

WORD = DataType(BASIC["uint32"], 32, scalar=True, order="big", alignment=4)


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("CFE_ES/HousekeepingTlm", "CFE_ES_HousekeepingTlm"),
        ("char@10", "char_10"),
        ("3D", "_3D"),
        ("", "unnamed"),
        ("\u00e9", "_"),
    ],
)
def test_a_name_in_c(name, own):
    assert c_name(name) == own


@pytest.mark.parametrize(("machine", "places", "size"), [(False, [0, 5], 72), (True, [0, 8], 96)])
def test_padding_and_the_end(machine, places, size):
    placement = Placement("big", machine=machine)
    assert placement.place("a", WORD) == ""
    placement.pad(8)
    assert placement.place("a", WORD) == ""
    assert [(item.name, item.offset) for item in placement.members] == [("a", places[0]), ("a2", places[1])]
    assert placement.end() == size
    assert placement.wrapped is None


def test_a_calibration_has_a_coefficient_for_each_power():
    assert polynomial({2.0: 0.5, 0: -40.0}) == (-40.0, 0.0, 0.5)
    assert polynomial({}) == ()


@pytest.mark.parametrize("power", [-1, 1.5, 65])
def test_a_power_that_no_calibration_has(power):
    with pytest.raises(SheetError, match=f"exponent {power} of a calibration is not 0 to 64"):
        polynomial({0: 1.0, power: 2.0})


def test_what_wraps_one_number():
    placement = Placement("big", machine=False)
    placement.place("Value", WORD)
    assert placement.wrapped is WORD


def test_more_than_any_packet():
    placement = Placement("big", machine=False)
    placement.pad(1 << 28)
    with pytest.raises(SheetError, match="its 33,554,432 bytes are more than any packet holds"):
        placement.end()


def test_the_rest_is_the_last():
    placement = Placement("little", machine=False)
    placement.pad(3)
    assert placement.open("list", WORD).startswith("its elements are not alike")
    assert (placement.members[-1].offset, placement.members[-1].dims, placement.varies) == (1, (OPEN,), True)


BOMB = b'<!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;&b;">]>\n<PackageFile>&c;</PackageFile>'
OUTSIDE = b'<!DOCTYPE a [<!ENTITY f SYSTEM "file:///etc/passwd">]><PackageFile>&f;</PackageFile>'


def test_a_node_knows_its_place_and_no_name_space():
    root = parse_document(
        b'<a:A xmlns:a="urn:x">\n <B name="n"\n  a:c="d" shortDescription="* \\brief two\n words"/>\n</a:A>',
        "f",
    )
    (inner,) = root.inside("B")
    assert (root.tag, inner.tag, str(inner)) == ("A", "B", "f:2")
    assert (inner.name, inner.attributes["c"], inner.doc) == ("n", "d", "two words")
    assert [item.tag for item in root.walk()] == ["A", "B"]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (BOMB, "f:1: a document type (<!DOCTYPE ...>) is not read"),
        (OUTSIDE, "f:1: a document type (<!DOCTYPE ...>) is not read"),
        (b'<!DOCTYPE a SYSTEM "http://x.example/a.dtd"><a/>', "f:1: a document type"),
        (b"<a>\n<b>\n</a>", "f:3: is not XML: mismatched tag"),
        (b"", "f:1: is not XML: no element found"),
        (b"<a>&c;</a>", "f:1: is not XML: undefined entity"),
        (b'<?xml version="1.0" encoding="klingon"?><a/>', "f: is not XML: unknown encoding"),
        (b"<a>" * 70, "f:1: more than 64 levels"),
        (b"<a>" + b"<b/>" * (1 << 18), "f:1: more than 64 levels or 262,144 elements"),
    ],
)
def test_what_is_refused(data, message):
    with pytest.raises(ConfigError) as error:
        parse_document(data, "f")
    assert str(error.value).startswith(message)


@settings(max_examples=examples(2000))
@given(st.binary(max_size=60) | st.text("<>/ab&;=' \n!?-[", max_size=60).map(str.encode))
def test_any_bytes_are_read_or_refused(data):
    with suppress(ConfigError):
        parse_document(data, "f")
