"""How much of a search a run of the tests does: a part in ``make test``, all of it in ``make long``."""

import os

import pytest

LONG = bool(os.environ.get("EDORAS_LONG"))
_ALL = LONG or os.environ.get("HYPOTHESIS_PROFILE") == "explore"
_PART = 8


def examples(count, part=_PART, least=10):
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
