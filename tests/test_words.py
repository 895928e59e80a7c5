"""Numbers, times, lists and suggestions as text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.words import (
    count,
    did_you_mean,
    duration,
    listed,
    milliseconds,
    plural,
    rate,
    seconds,
    size,
    utc,
)


def test_plural():
    assert [plural(number, "packet") for number in (0, 1, 1827)] == [
        "0 packets",
        "1 packet",
        "1,827 packets",
    ]


def test_seconds():
    assert [seconds(value) for value in (-0.06, 119.9, 120, 7200, 172_800, 1478876100.426)] == [
        "-0.1 s",
        "119.9 s",
        "120.0 s (2.0 minutes)",
        "7200.0 s (2.0 hours)",
        "172800.0 s (2.0 days)",
        "1478876100.4 s (46.9 years)",
    ]
    assert seconds(1478876100.426, 3) == "1478876100.426 s (46.9 years)"


def test_listed():
    assert listed(["a", "b", "c"], 3) == "a, b, c"
    assert listed(["a", "b", "c"], 2) == "a, b, ..."


def test_did_you_mean():
    names = ["linear.x", "linear.y", "angular.z"]
    assert did_you_mean("LINAER.X", names, 1) == "did you mean linear.x?"
    assert did_you_mean("linaer.x", names) == "did you mean linear.x or linear.y?"
    assert did_you_mean("speed", names) == ""


@pytest.mark.parametrize(
    ("function", "value", "expected"),
    [
        (count, 1827, "1,827"),
        (count, None, "-"),
        (rate, 10.0, "10.0 Hz"),
        (rate, 0.48, "0.48 Hz"),
        (rate, 249.7, "250 Hz"),
        (rate, 99.96, "100 Hz"),
        (rate, 100_000, "100.0 kHz"),
        (rate, None, "-"),
        (milliseconds, 0.421, "0.42 ms"),
        (milliseconds, 12.46, "12.5 ms"),
        (milliseconds, 427.2, "427 ms"),
        (milliseconds, 9800.0, "9.8 s"),
        (milliseconds, None, "-"),
        (size, 0, "0 B"),
        (size, 1023, "1023 B"),
        (size, 1024, "1.0 KiB"),
        (size, 1024**2 - 1, "1.0 MiB"),
        (size, 13_000_000, "12.4 MiB"),
        (size, 3 * 1024**5, "3,072.0 TiB"),
        (duration, 65.12, "65.1 s"),
        (duration, 99.97, "1:40"),
        (duration, 204, "3:24"),
        (duration, 3723, "1:02:03"),
        (duration, 2 * 86400 + 3723, "2 d 1:02:03"),
    ],
)
def test_figures(function, value, expected):
    assert function(value) == expected


def test_utc():
    assert utc(1_795_241_802_553_538_999) == "2026-11-21 06:16:42.553538"
    assert utc(1_795_241_802_553_538_999, digits=3) == "2026-11-21 06:16:42.553"
    assert utc(1_795_241_802_553_538_999, digits=0) == "2026-11-21 06:16:42"
    assert utc(-1) == "1969-12-31 23:59:59.999999"
    assert utc(10**30).endswith(" s")


@given(st.integers(-(1 << 63), (1 << 63) - 1))
def test_utc_of_any_capture_time(time_ns):
    assert len(utc(time_ns)) == 26
