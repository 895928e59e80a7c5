"""Python 3.10 is that of ROS 2 Humble: nothing newer is used, and what it does not have is in one file."""

import ast
import re

import pytest
from effort import LONG
from places import ROOT

from edoras_tools.older import Flags, StrEnum

NEWER = {("enum", "StrEnum"), ("datetime", "UTC"), ("typing", "Self"), ("typing", "assert_never")}
"""Names of Python 3.11. ``Self`` comes from ``typing_extensions``, where only types are checked."""
WORDS = re.compile(r"\b(StrEnum|UTC|Self|assert_never|tomllib|from_bytes)\b")


def newer(source):
    """The lines of a source that Python 3.10 cannot run, and why."""
    if not LONG and not WORDS.search(source):
        return  # ruff, which is told the version, has judged the syntax
    tree = ast.parse(source, feature_version=(3, 10))
    for node in ast.walk(tree):
        match node:
            case ast.ImportFrom(module=module, names=names):
                if used := {(module, item.name) for item in names} & NEWER:
                    yield node.lineno, f"{used}"
            case ast.Import(names=names) if node in tree.body and "tomllib" in {item.name for item in names}:
                yield node.lineno, "tomllib"
            case ast.Attribute(value=ast.Name(id=module), attr=name) if (module, name) in NEWER:
                yield node.lineno, f"{module}.{name}"
            case ast.Call(func=ast.Attribute(value=ast.Name(id="int"), attr="from_bytes")):
                if len(node.args) + len(node.keywords) < 2:
                    yield node.lineno, "no byte order"


def test_every_file_can_be_read_by_python_3_10():
    folders = "edoras_tools", "dissectors", "samples", *(("tests", "docs", ".ci") if LONG else ())
    by_folder = {folder: [*(ROOT / folder).rglob("*.py")] for folder in folders}
    assert all(by_folder.values())
    files = [path for own in by_folder.values() for path in own if path.name != "older.py"]
    found = {str(path.relative_to(ROOT)): [*newer(path.read_text(encoding="utf-8"))] for path in files}
    assert {path: lines for path, lines in found.items() if lines} == {}


@pytest.mark.parametrize(
    ("source", "lines"),
    [
        ("from enum import StrEnum", [1]),
        ("x = 1\nimport tomllib", [2]),
        ("def f():\n    import tomllib", []),
        ("import datetime\ndatetime.UTC", [2]),
        ("int.from_bytes(b'')\nint.from_bytes(b'', 'big')", [1]),
    ],
)
def test_what_is_newer_is_found(source, lines):
    assert [line for line, _ in newer(source)] == lines


class Colour(StrEnum):
    RED = "red"


class Bits(Flags):
    ONE = 1
    FOUR = 4


def test_what_stands_in_is_the_same():
    assert (str(Colour.RED), f"{Colour.RED}", Colour.RED) == ("red", "red", "red")
    assert [*Bits(5)] == [Bits.ONE, Bits.FOUR]
    assert [*Bits(0)] == []
    assert len(Bits(5)) == 2
