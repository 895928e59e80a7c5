"""XML of data sheets: lines, and what is refused before anything in it is believed."""

from contextlib import suppress

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.addons.databases.documents import parse_document
from edoras_tools.errors import ConfigError

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
