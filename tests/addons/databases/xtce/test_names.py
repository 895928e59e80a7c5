"""What a name means in nested space systems, and across files."""

import pytest

from edoras_tools.addons.databases.documents import Notes, SheetError, parse_document
from edoras_tools.addons.databases.xtce.names import Declarations

TREE = b"""<SpaceSystem name="A"><TelemetryMetaData><ParameterSet><Parameter name="x"/><Parameter name="x"/>
</ParameterSet></TelemetryMetaData><SpaceSystem name="B"><TelemetryMetaData><ParameterSet>
<Parameter name="x"/>
<Parameter name="y"/></ParameterSet></TelemetryMetaData></SpaceSystem></SpaceSystem>"""
OTHER = b"""<SpaceSystem name="C"><TelemetryMetaData><ParameterSet><Parameter name="z"/></ParameterSet>
</TelemetryMetaData></SpaceSystem>"""


@pytest.fixture
def names():
    notes = Notes()
    names = Declarations([parse_document(TREE, "a"), parse_document(OTHER, "c")], notes)
    assert notes.lines() == ("a:1: parameter /A/x is declared twice; the first holds",)
    return names


@pytest.mark.parametrize(
    ("name", "system", "path"),
    [
        ("x", "/A/B", "/A/B/x"),
        ("x", "/A", "/A/x"),
        ("../x", "/A/B", "/A/x"),
        ("B/y", "/A", "/A/B/y"),
        ("/A/B/y", "/C", "/A/B/y"),
        ("A/x", "/A/B", "/A/x"),
        ("/elsewhere/z", "/A", "/C/z"),
        ("../D/y", "/C", "/A/B/y"),
    ],
)
def test_a_name_is_looked_for_outwards(names, name, system, path):
    assert names.find("parameter", name, system).path == path


@pytest.mark.parametrize("name", ["q", "/D/x", "", "/", "//", ".."])
def test_what_nothing_or_more_than_one_has(names, name):
    with pytest.raises(SheetError, match="is in none of these files"):
        names.find("parameter", name, "/C")


@pytest.mark.parametrize(
    ("name", "path", "member"),
    [("x/a/b", "/A/x", "/a/b"), ("x.a", "/A/x", "/a"), ("x", "/A/x", ""), ("B/y.m", "/A/B/y", "/m")],
)
def test_a_member_of_a_parameter(names, name, path, member):
    item, rest = names.find_member(name, "/A")
    assert (item.path, rest) == (path, member)


def test_a_member_of_nothing(names):
    with pytest.raises(SheetError, match=r"parameter q\.a is in none"):
        names.find_member("q.a", "/A")
