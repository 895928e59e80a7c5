"""Design parameters and their arithmetic, against what Python makes of the same text."""

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.addons.databases.documents import SheetError
from edoras_tools.addons.databases.eds.parameters import Parameters

PARAMETERS = Parameters(
    {
        "A/ONE": "1",
        "A/SUM": "${ONE} + 1",
        "A/FAR": "${B/C/DEEP} * 2",
        "B/C/DEEP": " ${A/SUM} ",
        "A/HEADER": "SpacePacketBasic",
        "A/LOOP": "${B/LOOP}",
        "B/LOOP": "${A/LOOP} + 1",
        "A/B0": "x" * 100,
        **{f"A/B{level}": f"${{A/B{level - 1}}}" * 10 for level in range(1, 30)},
    }
)


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        ("5", 5),
        ("0x1F", 31),
        ("${SUM} * 3", 6),
        ("${A/FAR} - 1", 3),
        ("2 ^ 3 ^ 2 - -1", 513),
        ("-2 ^ 2", -4),
        ("2 ^ ${A/ONE}", 2),
        ("(1 + 2) * 7 / 3", 7),
        ("7 / 2", 3.5),
        ("1e3", 1000),
        ("001 + 008", 9),
    ],
)
def test_a_number(raw, value):
    assert PARAMETERS.number(raw, "A") == value


def test_a_text_stands_for_itself():
    assert PARAMETERS.text("CCSDS/${A/HEADER}", "A") == "CCSDS/SpacePacketBasic"
    assert PARAMETERS.text("uint${SUM}", "A") == "uint2"


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        ("${A/NONE}", "parameter A/NONE is in none of these files"),
        ("${LOOP}", "parameter A/LOOP contains itself"),
        ("${B29}", "stands for more than 1000 characters"),
        ("__import__('os').system('true')", "is no number"),
        ("1 +", "is no number"),
        ("1 2", "is no number"),
        ("", "is no number"),
        ("²", "is no number"),
        ("٣", "is no number"),
        ("(1", "a parenthesis is not closed"),
        ("1 / 0", "divides by 0"),
        ("2 ^ 65", "has no value here"),
        ("9 ^ 9 ^ 9 ^ 9", "has no value here"),
        ("0 ^ -1", "has no value here"),
        ("2 ^ 64 * 2", "is over 2^64"),
        ("1e400", "is over 2^64"),
        ("1e19 ^ 64", "is over 2^64"),
        ("(" * 40 + "1" + ")" * 40, "is nested too deeply"),
        ("-" * 900 + "1", "is nested too deeply"),
    ],
)
def test_what_is_no_number(raw, why):
    with pytest.raises(SheetError, match=why.replace("^", r"\^")):
        PARAMETERS.number(raw, "A")


def test_an_integer():
    with pytest.raises(SheetError, match=r"'7 / 2' is 3\.5, no integer"):
        PARAMETERS.integer("7 / 2", "A")
    assert PARAMETERS.integer("7 / 2 * 2", "A") == 7


@settings(max_examples=examples(2000))
@given(st.text("0123456789.x+-*/^() ${}AONE", max_size=40))
def test_any_text_is_a_number_as_python_has_it_or_refused(raw):
    try:
        value = PARAMETERS.number(raw, "A")
    except SheetError:
        return
    if "$" not in raw and "x" not in raw and not any(part.startswith("0") for part in raw.split()):
        try:
            expected = eval(raw.strip().replace("^", "**"))  # of the letters above
        except SyntaxError:  # a zero in front of a number, which Python does not read
            return
        assert value == pytest.approx(expected)
