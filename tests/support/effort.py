"""How much of a search a run of the tests does: a part in ``make test``, all of it in ``make long``.

A test marked ``long`` is for ``make long``; with patterns of ids only the cases are that match one. Of a test
marked ``quick`` with patterns, ``make test`` runs the cases that match one; of one marked ``each`` with a
number, and no name to its cases that says which matter, the first of so many.
"""

import os
from collections import Counter, defaultdict
from fnmatch import fnmatchcase

import pytest

LONG = bool(os.environ.get("EDORAS_LONG"))
_ALL = LONG or os.environ.get("HYPOTHESIS_PROFILE") == "explore"
_PART = 32


def examples(count, part=_PART, least=6):
    """Return how many of ``count`` examples this run draws: one of ``part``, but so many at least."""
    return count if _ALL else min(count, max(least, count // part))


def every(stride, items):
    """Return each ``stride``-th of the items; a prime one meets every place of what repeats in eights."""
    return list(items) if LONG else list(items)[::stride]


def long_but(quick, values):
    """Return the values as parameters of a test, of which ``make test`` runs those in ``quick``."""
    cases = [value if isinstance(value, tuple) else (value,) for value in values]
    marks = [() if value in quick else pytest.mark.long for value in values]
    return [pytest.param(*case, marks=mark) for case, mark in zip(cases, marks, strict=True)]


def split(items):
    """Return the tests that this run does, and those that it leaves to ``make long``."""
    kept, left, cases = [], [], Counter()
    for item in items:
        away = not LONG and _is_long(item)
        if not away and not LONG and (mark := item.get_closest_marker("each")):
            test = item.nodeid.partition("[")[0]
            away = cases[test] % mark.args[0] > 0
            cases[test] += 1
        (left if away else kept).append(item)
    return kept, left


def unmatched(items):
    """Return the patterns, each with its test, that match no case of it: misspelt, it would hide cases."""
    cases, tests = defaultdict(list), {}
    for item in items:
        test = item.nodeid.partition("[")[0]
        cases[test].append(_case(item))
        tests[test] = item
    return [
        (test, pattern)
        for test, item in tests.items()
        for mark in item.iter_markers()
        if mark.name in {"quick", "long"}
        for pattern in mark.args
        if not any(fnmatchcase(case, pattern) for case in cases[test])
    ]


def _case(item):
    return item.callspec.id if hasattr(item, "callspec") else ""


def _is_long(item):
    case = _case(item)
    for mark in item.iter_markers():
        if mark.name in {"quick", "long"}:
            among = any(fnmatchcase(case, pattern) for pattern in mark.args)
            if not among if mark.name == "quick" else among or not mark.args:
                return True
    return False
