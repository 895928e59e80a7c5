"""How large the project is: figures that a table shows, each with a limit that only gets smaller.

A figure over its limit fails: make something smaller, or raise the limit by what the issue names, in the same
commit. A figure that fell fails too, once it fell by more than its slack: write the new figure as the limit.
``pytest -s tests/test_budget.py`` prints the table.
"""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from functools import cache
from statistics import median
from typing import NamedTuple

import pytest
from places import ROOT

PACKAGE = ROOT / "edoras_tools"
ADDONS = PACKAGE / "addons"


class Limit(NamedTuple):
    """What a figure may be.

    Attributes:
        at_most: the figure when this limit was written.
        slack: how far the figure may fall before the limit has to follow.
        goal: what it is to become.
    """

    at_most: float
    slack: float
    goal: float


LIMITS = {
    "lines with code, core": Limit(56_035, 150, 58_000),
    "lines with code, all": Limit(89_033, 150, 84_000),  # with what is still to come
    "files": Limit(376, 10, 450),
    "files below 170 lines, of 1,000": Limit(247, 10, 500),  # a median of 170 lines or more
    "folders with one file": Limit(0, 0, 0),
    "files that record runs through": Limit(80, 2, 80),
    "files that sniff --where runs through": Limit(80, 2, 80),
    "modules that host loads": Limit(33, 2, 40),
    "bare participles among 1,000 names": Limit(0.7, 1, 3),
    "functions of complexity over 25": Limit(0, 0, 0),
}

BARE = re.compile(
    r"_?(told|found|given|chosen|taken|made|known|wanted|shown|said|seen|left|held|kept|begun|done|gone|named"
    r"|meant|asked|counted|stored|there|here|what|anew)"
)
"""Participles and pronouns that say nothing where they stand alone as a name."""

RUN_THROUGH = """
import json, sys, threading
from edoras_tools.cli import programs
folder, files = sys.argv.pop(1), set()
def enter(frame, event, _):
    if event == "call" and frame.f_code.co_flags & 1 and frame.f_code.co_filename.startswith(folder):
        files.add(frame.f_code.co_filename)  # the flag: a function, not the body of a module or of a class
def end(code):
    sys.setprofile(None)
    modules = [name for name in sys.modules if name.partition(".")[0] == "edoras_tools"]
    sys.stderr.write("\\n" + json.dumps([len(files), len(modules)]))
    sys.stderr.flush()
    leave(code)
leave, programs.os._exit = programs.os._exit, end
threading.setprofile(enter)
sys.setprofile(enter)
programs.main()
"""


class Counted(NamedTuple):
    """What a file of the package counts.

    Attributes:
        lines: all its lines.
        code: those with code: not blank, no docstring, no comment.
        names: of variables, parameters, functions and classes, each place that defines one.
        bare: those of them that are a bare participle or pronoun.
        complex: functions with more than 25 ways, one for each branch, loop, handler and condition.
    """

    lines: int
    code: int
    names: int
    bare: int
    complex: int


NAMES = {ast.arg: "arg", ast.Name: "id", ast.FunctionDef: "name", ast.ClassDef: "name"}
BRANCHES = {ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler}


def counted(text):
    """Count a file."""
    rows = [row.strip() for row in text.splitlines()]
    names, functions, prose, strings, ways = [], [], set(), set(), [0] * (len(rows) + 1)
    for node in ast.walk(ast.parse(text)):
        kind = type(node)
        if kind in NAMES and (kind is not ast.Name or isinstance(node.ctx, ast.Store)):
            names.append(getattr(node, NAMES[kind]))
        if kind is ast.FunctionDef:
            functions.append(node)
        elif kind is ast.Expr and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            prose.update(range(node.lineno, node.end_lineno + 1))
        elif kind in {ast.Constant, ast.JoinedStr}:
            strings.update(range(node.lineno + 1, node.end_lineno + 1))
        elif kind is ast.match_case:
            ways[node.pattern.lineno] += 1
        elif kind is ast.comprehension:
            ways[node.target.lineno] += 1 + len(node.ifs)
        elif kind in BRANCHES:
            ways[node.lineno] += 1
        elif kind is ast.BoolOp:
            ways[node.lineno] += len(node.values) - 1
    code = [
        number
        for number, row in enumerate(rows, 1)
        if row and number not in prose and (row[0] != "#" or number in strings)
    ]
    return Counted(
        lines=len(rows),
        code=len(code),
        names=len(names),
        bare=sum(bool(BARE.fullmatch(item)) for item in names),
        complex=sum(1 + sum(ways[item.lineno : item.end_lineno + 1]) > 25 for item in functions),
    )


@cache
def files():
    """Count every file that has code."""
    found = {path: counted(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    return {path: item for path, item in found.items() if item.code}


def folders_with_one_file():
    folders = [path.parent for path in files() if path.name != "__init__.py"]
    return sum(folders.count(folder) == 1 for folder in {*folders} - {ADDONS})


def started(folder, *words):
    """Start a command that says how many of our files it runs through, and how many modules it loads."""
    return subprocess.Popen(
        [sys.executable, "-c", RUN_THROUGH, PACKAGE, *words],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "HOME": str(folder)},
    )


def ended(process):
    """Return both numbers of a command that was started."""
    said = process.communicate()[1]
    assert "Traceback" not in said, said
    return json.loads(said.splitlines()[-1])


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget")
    mission = ("-c", ROOT / "samples/missions/single_arm_ground.yaml")
    read = (ROOT / "samples/captures/b_arm_single.pcap", *mission)
    record = started(folder, "record", "--jobs", "1", "-r", *read, "-o", "a.mcap")
    sniff = started(folder, "sniff", *read, "--where", "msg_id == 0x827 and position[0] > 0")
    host = started(folder, "host")
    every = files().values()
    return {
        "lines with code, core": sum(
            item.code for path, item in files().items() if ADDONS not in path.parents
        ),
        "lines with code, all": sum(item.code for item in every),
        "files": len(every),
        "files below 170 lines, of 1,000": round(1000 * sum(item.lines < 170 for item in every) / len(every)),
        "folders with one file": folders_with_one_file(),
        "files that record runs through": ended(record)[0],
        "files that sniff --where runs through": ended(sniff)[0],
        "modules that host loads": ended(host)[1],
        "bare participles among 1,000 names": round(
            1000 * sum(item.bare for item in every) / sum(item.names for item in every), 1
        ),
        "functions of complexity over 25": sum(item.complex for item in every),
    }


def judged(figures, limits):
    """Return what is wrong with figures, a line each."""
    for name, figure in figures.items():
        limit = limits[name]
        if figure > limit.at_most:
            yield f"{name}: {figure:,} is over the limit of {limit.at_most:,}"
        elif figure < limit.at_most - limit.slack:
            yield f"{name}: {figure:,} is well below the limit of {limit.at_most:,}; lower the limit to it"


def test_figures_keep_to_their_limits(figures):
    assert figures.keys() == LIMITS.keys()
    print(f"\n{'figure':40}{'today':>9}{'limit':>9}{'goal':>9}")
    for name, limit in LIMITS.items():
        print(f"{name:40}{figures[name]:>9,}{limit.at_most:>9,}{limit.goal:>9,}")
    print(f"median lines of a file: {median(item.lines for item in files().values()):g} (goal 170)")
    assert list(judged(figures, LIMITS)) == []


def test_a_limit_is_kept_and_follows():
    limits = {"files": Limit(100, 10, 50)}
    assert list(judged({"files": 100}, limits)) == []
    assert list(judged({"files": 90}, limits)) == []
    assert list(judged({"files": 101}, limits)) == ["files: 101 is over the limit of 100"]
    assert list(judged({"files": 89}, limits)) == [
        "files: 89 is well below the limit of 100; lower the limit to it"
    ]


def test_what_counts_as_code_and_as_a_name():
    text = '''"""Docstring,
of two lines."""

LINES = """
# part of a string
"""
"""What it is."""


def found(given, value):  # 2 names, one of them bare, and a bare one of the function
    """Say so."""
    # a comment
    told = [item for item in given]
    told.append(value)
    return (
        told
    )
'''
    assert counted(text) == Counted(lines=17, code=9, names=6, bare=3, complex=0)


@pytest.mark.parametrize(("branches", "number"), [(24, 0), (25, 1)])
def test_a_function_with_too_many_ways_is_counted(branches, number):
    body = "".join(f"    if value == {item}:\n        return {item}\n" for item in range(branches))
    assert counted(f"def function(value):\n{body}").complex == number
