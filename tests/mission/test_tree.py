"""rcl's rules for scalars, by a table and against the C library that rcl itself calls."""

from __future__ import annotations

import ctypes
import math
import sys

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from edoras_tools.mission import read_scalar

TRUE = ["y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"]
FALSE = ["n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"]

CASES = [
    *((word, True) for word in TRUE),
    *((word, False) for word in FALSE),
    ("yEs", "yEs"),
    ("null", "null"),
    ("~", "~"),
    ("", ""),
    ("0", 0),
    ("-0", 0),
    ("+7", 7),
    ("0x1827", 0x1827),
    ("0X82b", 0x82B),
    ("-0x10", -16),
    ("010", 8),
    ("08", 8.0),
    ("0o17", "0o17"),
    ("0b11", "0b11"),
    ("1_000", "1_000"),
    ("0x", "0x"),
    ("12 ", "12 "),
    ("1:30", "1:30"),
    ("٣", "٣"),
    ("9223372036854775807", 2**63 - 1),
    ("-9223372036854775808", -(2**63)),
    ("9223372036854775808", 2.0**63),
    ("0xFFFFFFFFFFFFFFFFF", float(16**17 - 1)),
    ("00000000000000000000000000000000000000000000000000000000000000000000000007", 7),
    ("1e3", 1000.0),
    ("1.", 1.0),
    (".5", 0.5),
    ("-2.5E-1", -0.25),
    ("0x1.8p3", 12.0),
    ("1e", "1e"),
    ("1e400", "1e400"),
    ("1e-400", "1e-400"),
    ("1e-310", "1e-310"),
    ("0e-400", 0.0),
    ("0x1p99999", "0x1p99999"),
    (".inf", math.inf),
    ("-.INF", -math.inf),
    ("+.Inf", math.inf),
    (".iNF", ".iNF"),
    ("inf", math.inf),
    ("-Infinity", -math.inf),
    ("-.nan", "-.nan"),
    ("127.0.0.1", "127.0.0.1"),
    ("geometry_msgs/msg/Twist", "geometry_msgs/msg/Twist"),
]


@pytest.mark.parametrize(("text", "value"), CASES)
def test_value_and_kind(text, value):
    got = read_scalar(text)
    assert got == value
    assert type(got) is type(value)


@pytest.mark.parametrize("text", [".nan", ".NaN", ".NAN", "nan", "-NaN", "nan(1_a)"])
def test_not_a_number(text):
    got = read_scalar(text)
    assert isinstance(got, float)
    assert math.isnan(got)


@pytest.mark.parametrize(("text", "value"), CASES)
def test_quotes_make_a_string(text, value):
    assert read_scalar(text, quoted=True) == text


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the C library's limits are glibc's here")
@settings(deadline=None)
@given(
    st.one_of(
        st.text(),
        st.text("0123456789abcdefxXpPeE+-._ \tinfNA()", max_size=24),
        st.integers().map(str),
        st.integers().map(hex),
        st.floats().map(repr),
        st.floats().map(float.hex),
    )
)
@example("0x.")
@example(".")
@example("\v12")
@example("1e5000000000000000000000")
def test_the_c_library_agrees(text):
    assume("\0" not in text and text.isprintable() | text.isspace())
    libc = ctypes.CDLL(None, use_errno=True)
    libc.strtol.argtypes = (ctypes.c_char_p, ctypes.POINTER(ctypes.c_char_p), ctypes.c_int)
    libc.strtol.restype = ctypes.c_long
    libc.strtod.argtypes = (ctypes.c_char_p, ctypes.POINTER(ctypes.c_char_p))
    libc.strtod.restype = ctypes.c_double

    def convert(function, *arguments):
        """Return the value where all of a text that is not empty was taken, and within range."""
        raw = text.encode("utf-8", "surrogatepass")
        buffer, end = ctypes.create_string_buffer(raw), ctypes.c_char_p()
        ctypes.set_errno(0)
        value = function(ctypes.cast(buffer, ctypes.c_char_p), ctypes.byref(end), *arguments)
        taken = ctypes.cast(end, ctypes.c_void_p).value - ctypes.addressof(buffer)
        return value if ctypes.get_errno() == 0 and taken and taken == len(raw) else None

    got = read_scalar(text)
    integer, number = convert(libc.strtol, 0), convert(libc.strtod)
    if text in {*TRUE, *FALSE} or text.lstrip("+-")[:2].lower() in {".i", ".n"}:
        return
    if integer is not None:
        assert type(got) is int
        assert got == integer
    elif number is not None:
        # glibc takes a subnormal that is exact; here every subnormal is a range error.
        assume(number == 0 or abs(number) >= sys.float_info.min)
        assert type(got) is float
        assert got == number or (math.isnan(got) and math.isnan(number))
    else:
        assert got == text
