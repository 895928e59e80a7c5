"""The search itself: what it tries, in which order, and what it knows at the end."""

from __future__ import annotations

import doctest

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.sweep import plan
from edoras_tools.addons.lab.sweep.plan import Bisection
from edoras_tools.errors import ConfigError


def tried(search, limit):
    values = []
    while (value := search.next) is not None:
        values.append(value)
        search.tell(value, good=value <= limit)
    return values


@pytest.mark.parametrize(
    ("first", "last", "limit", "values", "good", "bad"),
    [
        (1, 1000, 8, [1, 2, 4, 8, 16, 12, 10, 9], 8, 9),
        (1, 1000, 1, [1, 2], 1, 2),
        (3, 20, 2, [3], None, 3),
        (3, 20, 20, [3, 6, 12, 20], 20, None),
        (5, 5, 5, [5], 5, None),
        (1, 10, 9, [1, 2, 4, 8, 10, 9], 9, 10),
    ],
)
def test_doubling_then_halving(first, last, limit, values, good, bad):
    search = Bisection(first, last)
    assert tried(search, limit) == values
    assert (search.good, search.bad) == (good, bad)


def test_precision_saves_steps_where_numbers_are_large():
    exact, near = Bisection(1, 65535), Bisection(1, 65535, precision=0.02)
    assert len(tried(near, 1000)) < len(tried(exact, 1000))
    assert (exact.good, exact.bad) == (1000, 1001)
    assert near.good <= 1000 < near.bad <= near.good * 1.02


@given(st.integers(1, 2000), st.integers(0, 3000), st.integers(0, 4000))
def test_it_finds_every_limit_in_few_steps(first, more, limit):
    last = first + more
    search = Bisection(first, last)
    assert len(tried(search, limit)) <= 2 * last.bit_length() + 2
    assert search.good == (min(limit, last) if limit >= first else None)
    assert search.bad == (None if limit >= last else max(limit + 1, first))


@pytest.mark.parametrize(("first", "last"), [(0, 5), (-1, 5), (6, 5)])
def test_a_range_that_is_none(first, last):
    with pytest.raises(ConfigError, match="not a rising range from 1"):
        Bisection(first, last)


def test_the_example_is_right():
    assert doctest.testmod(plan).failed == 0
