"""The value that a ROS 2 node gives to a YAML scalar.

ROS 2 does not use YAML's own schema: ``rcl_yaml_param_parser`` tries a list of words, then C's ``strtol``
with base 0, then ``strtod``, and takes everything else as a string. ``0x1827`` is an integer, ``010`` is 8,
``08`` and ``1e3`` are floats, ``yes`` is true, ``0o17`` and ``1_000`` are strings, and so is anything in
quotes.
"""

from __future__ import annotations

import math
import re
import sys

_WORDS = {
    word: value
    for value, words in ((True, "y yes true on"), (False, "n no false off"))
    for lower in words.split()
    for word in (lower, lower.capitalize(), lower.upper())
}
_SPECIALS = {
    f"{sign}.{word}": float(sign + word) for word in ("inf", "Inf", "INF") for sign in ("", "+", "-")
}
_SPECIALS |= dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan)
# The whole text must match, after the white space that strtol and strtod skip. ASCII digits only, as in C.
_INTEGER = r"[ \t-\r]*([+-]?)(?:0[xX]([0-9a-fA-F]+)|(0[0-7]*)|([1-9][0-9]*))"
_DECIMAL = r"[ \t-\r]*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_HEXADECIMAL = r"[ \t-\r]*[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?"
_NOT_FINITE = r"[ \t-\r]*([+-]?)(?i:(inf|infinity)|nan(?:\([0-9a-z_]*\))?)"


def read_scalar(text: str, *, quoted: bool = False) -> bool | int | float | str:
    """Return the value that rcl gives to a scalar.

    Args:
        text: the scalar, escapes resolved, quotes removed.
        quoted: it stood in single or double quotes, or under the tag ``!!str``: then it is a string.

    Returns:
        A bool, an int of 64 bits, a float, or the text itself. An integer too large for 64 bits is a float,
        and a float that a double cannot hold is a string, because C's conversions report a range error.
    """
    if quoted:
        return text
    if text in _WORDS:
        return _WORDS[text]
    integer = _integer(text)
    if integer is not None:
        return integer
    number = _float(text)
    return text if number is None else number


def _integer(text: str) -> int | None:
    match = re.fullmatch(_INTEGER, text)
    if match is None:
        return None
    sign, hexadecimal, octal, decimal = match.groups()
    digits, base = (hexadecimal, 16) if hexadecimal else (octal, 8) if octal else (decimal, 10)
    digits = digits.lstrip("0") or "0"
    if len(digits) > 64:
        return None  # out of range in any base, and int() refuses thousands of digits
    value = int(sign + digits, base)
    return value if -(2**63) <= value < 2**63 else None


def _float(text: str) -> float | None:
    if text in _SPECIALS:
        return _SPECIALS[text]
    if match := re.fullmatch(_NOT_FINITE, text):
        sign = -1.0 if match[1] == "-" else 1.0
        return math.copysign(math.inf if match[2] else math.nan, sign)
    if re.fullmatch(_HEXADECIMAL, text):
        mantissa = re.split("[pP]", text.lstrip(" \t\n\v\f\r"))[0].lstrip("+-")[2:]
        try:
            value = float.fromhex(text)
        except OverflowError:
            return None
    elif re.fullmatch(_DECIMAL, text):
        mantissa = re.split("[eE]", text)[0]
        value = float(text)
    else:
        return None
    if math.isinf(value):
        return None
    # A subnormal result, or a zero made of other digits, is glibc's ERANGE too.
    underflow = abs(value) < sys.float_info.min and re.search("[1-9a-fA-F]", mantissa) is not None
    return None if underflow else value
