"""A function takes at most eight parameters; what belongs together is a value that holds it.

Constructors are counted as they are written; a dataclass or a ``NamedTuple``, whose fields are its values, is
such a value, and has as many fields as it needs.
"""

from __future__ import annotations

import ast

import pytest
from places import ROOT

MOST = 8


def parameters(function):
    """The parameters of a function as its caller sees them: ``self`` and ``cls`` are none."""
    given = function.args
    names = [item.arg for item in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [item.arg for item in (given.vararg, given.kwarg) if item]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def too_many(tree):
    """The functions of a syntax tree with more parameters than that: line, name, how many."""
    functions = [
        item
        for item in ast.walk(tree)
        if isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
    ]
    return [
        (item.lineno, getattr(item, "name", "lambda"), len(parameters(item)))
        for item in functions
        if len(parameters(item)) > MOST
    ]


def test_no_function_has_more():
    files = [path for folder in ("edoras_tools", "dissectors") for path in (ROOT / folder).rglob("*.py")]
    assert len(files) > 100
    found = {path.relative_to(ROOT): too_many(ast.parse(path.read_text(encoding="utf-8"))) for path in files}
    assert {path: functions for path, functions in found.items() if functions} == {}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def f(a, b, c, d, e, f, g, h): ...", []),
        ("def f(a, b, c, d, e, f, g, h, i): ...", [(1, "f", 9)]),
        ("async def f(a, b, /, c, d, *e, f, g, h, **i): ...", [(1, "f", 9)]),
        ("f = lambda a, b, c, d, e, f, g, h, i: a", [(1, "lambda", 9)]),
        ("class C:\n    def __init__(self, a, b, c, d, e, f, g, h): ...", []),
        ("class C:\n    def __init__(self, a, b, c, d, e, f, g, h, i): ...", [(2, "__init__", 9)]),
    ],
)
def test_what_is_counted(source, found):
    assert too_many(ast.parse(source)) == found
