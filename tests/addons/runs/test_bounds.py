"""Bounds as people write them."""

import pytest

from edoras_tools.addons.runs.expectations import Unit, parse_bound


@pytest.mark.parametrize(
    ("text", "unit", "inside", "outside"),
    [
        ("600", Unit.MESSAGES, [600], [599, 601]),
        ("590..610", Unit.MESSAGES, [590, 610], [589, 611]),
        ("at least 1", Unit.MESSAGES, [1, 10**9], [0]),
        (">= 1", Unit.MESSAGES, [1], [0]),
        ("at most 76 bytes", Unit.BYTES, [0, 76], [77]),
        ("9.5 .. 10.5 Hz", Unit.RATE, [9.5, 10.5], [9.4, 10.6]),
        ("<=300ms", Unit.TIME, [0, 0.3], [0.301]),
        ("1s..2m", Unit.TIME, [1, 120], [0.999, 121]),
        ("0", Unit.LOSS, [0], [1]),
        ("at most 12", Unit.LOSS, [12], [13]),
        ("at most 1.5%", Unit.LOSS, [0, 0.015], [0.0151]),
    ],
)
def test_what_holds(text, unit, inside, outside):
    bound = parse_bound(text, unit)
    assert bound.text == text
    assert bound.share == ("%" in text)
    assert [bound.holds(value) for value in (*inside, *outside)] == [True] * len(inside) + [False] * len(
        outside
    )


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("", Unit.MESSAGES),
        ("many", Unit.MESSAGES),
        ("1.5", Unit.MESSAGES),
        ("-1", Unit.MESSAGES),
        ("10..9", Unit.MESSAGES),
        ("10", Unit.RATE),
        ("300ms", Unit.TIME),
        ("at most 3 parsecs", Unit.TIME),
        ("at most nan", Unit.TIME),
        ("1%", Unit.LOSS),
        ("at most 101%", Unit.LOSS),
        ("1..2%", Unit.LOSS),
        ("at most x%", Unit.LOSS),
        ("5%", Unit.MESSAGES),
    ],
)
def test_what_is_no_bound(text, unit):
    with pytest.raises(ValueError, match="is no bound; write") as told:
        parse_bound(text, unit)
    assert unit.value in str(told.value)


@pytest.mark.parametrize("unit", Unit)
def test_the_examples_of_the_messages_are_bounds(unit):
    for text in unit.value.replace(" or ", ", ").split(", "):
        assert parse_bound(text, unit).unit is unit
