"""Python 3.10 is that of ROS 2 Humble: nothing newer is used, and what it does not have is in one file."""

import ast

import pytest
from places import ROOT

from edoras_tools.older import Flags, StrEnum

NEWER = {("enum", "StrEnum"), ("datetime", "UTC"), ("typing", "Self"), ("typing", "assert_never")}
"""Names of Python 3.11. ``Self`` comes from ``typing_extensions``, where only types are checked."""
FILES = sorted(
    path
    for folder in ("edoras_tools", "dissectors", "samples", "tests", "docs", ".ci")
    for path in (ROOT / folder).rglob("*.py")
    if path.name != "older.py"
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_can_be_read_by_python_3_10(path):
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not {(node.module, item.name) for item in node.names} & NEWER, node.lineno
        if isinstance(node, ast.Import) and node in tree.body:
            assert "tomllib" not in {item.name for item in node.names}, node.lineno
        if isinstance(node, ast.Attribute):
            assert ast.unparse(node) not in {"enum.StrEnum", "datetime.UTC", "typing.Self"}, node.lineno
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "int.from_bytes":
            assert len(node.args) + len(node.keywords) >= 2, f"line {node.lineno}: no byte order"


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
