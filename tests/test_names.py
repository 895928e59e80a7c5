"""One name, one meaning: no public name is defined at the top of two modules, but for those listed here.

A name of the package is what stands at the top of a module without an underscore: a class, a function, an
alias, a constant.
"""

from __future__ import annotations

import re
from collections import defaultdict
from fnmatch import fnmatchcase
from functools import cache

from places import ROOT

PACKAGE = ROOT / "edoras_tools"

SAME = (
    ("checksum", "diagnosis/rules/commands.py wire/cfe.py", "the rule, named as its verdicts are"),
    (
        "host_drops",
        "diagnosis/rules/pipes.py diagnosis/quality.py",
        "the rule, and what it judges",
    ),
    (
        "open_graph",
        "middleware/* addons/*/graph.py",
        "what every middleware has, and what chooses one",
    ),
    ("emit", "wire/*", "written and read through the header's module: ccsds.emit, sbn.emit"),
    ("live_table", "render/* addons/*/views.py", "the view of a command while it runs"),
    ("outcome", "render/* addons/*/views.py", "the view of what a command did"),
    ("plan", "render/*", "the view of what a command would do"),
    ("examine", "doctor.py pipelines/doctor.py", "the library's door to the same function"),
    ("predict", "doctor.py diagnosis/accounting/budget.py", "the library's door to the same function"),
)
"""A name, where it may be defined, and why it means the same there."""

FACTS = ("cfs/*", "addons/lab/emulator/apps/generator.py")
"""Facts of one application each, and read through its module: ``command_ingest.PIPE``, ``sbn.PIPE``."""

COMMANDS = ("cli/*", "addons/*/cli.py", "addons/*/cli/*")
"""The command line names commands, options and their readers after what they are about; nothing else of the
package imports it."""


DEFINED = re.compile(r"^(?:(?:class|def) (\w+)|(\w+(?:, \w+)*)(?:: [^=\n]+)? = )", re.MULTILINE)
"""What begins at the left edge; to make a syntax tree of every file takes ten times as long."""


def defined(text):
    """The public names that a module defines at its top."""
    names = (name for match in DEFINED.finditer(text) for name in (match[1] or match[2]).split(", "))
    return {name for name in names if not name.startswith("_")}


@cache
def homes():
    """The modules that define each name."""
    found = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        for name in defined(path.read_text(encoding="utf-8")):
            found[name].add(path.relative_to(PACKAGE).as_posix())
    return found


def allowed(name, module):
    """The patterns that let a name stand in a module."""
    if any(fnmatchcase(module, item) for item in COMMANDS):
        return True
    return any(
        name == item and any(fnmatchcase(module, pattern) for pattern in where.split())
        for item, where, _ in SAME
    )


def twice(found):
    """The names with more than one home, and their homes that nothing here explains."""
    out = {}
    for name, modules in found.items():
        left = {module for module in modules if not allowed(name, module)}
        facts = {module for module in left if any(fnmatchcase(module, item) for item in FACTS)}
        if len(left) > 1 and left != facts:
            out[name] = sorted(left)
    return out


def test_no_name_has_two_meanings():
    assert twice(homes()) == {}


def test_a_second_meaning_is_found():
    assert twice({"Kind": {"wire/a.py", "ros/b.py"}}) == {"Kind": ["ros/b.py", "wire/a.py"]}
    assert twice({"PIPE": {"cfs/a.py", "ros/b.py"}}) == {"PIPE": ["cfs/a.py", "ros/b.py"]}
    assert twice({"PIPE": {"cfs/a.py", "cfs/b.py"}, "sniff": {"cli/sniff.py", "pipelines/sniff.py"}}) == {}


def test_what_stands_at_the_left_edge_is_defined():
    text = "A = 1\nB, C = 2, 3\nD: int = 4\n_E = 5\nclass F:\n    g = 6\ndef h(i=7): ...\nj.k = 8\n"
    assert defined(text) == {*"ABCDFh"}


def test_what_is_listed_is_there():
    found = homes()
    for name, where, _ in SAME:
        for pattern in where.split():
            assert any(fnmatchcase(module, pattern) for module in found[name]), (name, pattern)
