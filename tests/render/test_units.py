from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.render import units


@pytest.mark.parametrize(
    ("function", "value", "expected"),
    [
        (units.count, 1827, "1,827"),
        (units.count, None, "-"),
        (units.rate, 10.0, "10.0 Hz"),
        (units.rate, 0.48, "0.48 Hz"),
        (units.rate, 249.7, "250 Hz"),
        (units.rate, 99.96, "100 Hz"),
        (units.rate, 100_000, "100.0 kHz"),
        (units.rate, None, "-"),
        (units.milliseconds, 0.421, "0.42 ms"),
        (units.milliseconds, 12.46, "12.5 ms"),
        (units.milliseconds, 427.2, "427 ms"),
        (units.milliseconds, 9800.0, "9.8 s"),
        (units.milliseconds, None, "-"),
        (units.size, 0, "0 B"),
        (units.size, 1023, "1023 B"),
        (units.size, 1024, "1.0 KiB"),
        (units.size, 1024**2 - 1, "1.0 MiB"),
        (units.size, 13_000_000, "12.4 MiB"),
        (units.size, 3 * 1024**5, "3,072.0 TiB"),
        (units.duration, 65.12, "65.1 s"),
        (units.duration, 99.97, "1:40"),
        (units.duration, 204, "3:24"),
        (units.duration, 3723, "1:02:03"),
        (units.duration, 2 * 86400 + 3723, "2 d 1:02:03"),
    ],
)
def test_figures(function, value, expected):
    assert function(value) == expected


def test_utc():
    assert units.utc(1_795_241_802_553_538_999) == "2026-11-21 06:16:42.553538"
    assert units.utc(1_795_241_802_553_538_999, digits=3) == "2026-11-21 06:16:42.553"
    assert units.utc(1_795_241_802_553_538_999, digits=0) == "2026-11-21 06:16:42"
    assert units.utc(-1) == "1969-12-31 23:59:59.999999"
    assert units.utc(10**30).endswith(" s")


@given(st.integers(-(1 << 63), (1 << 63) - 1))
def test_utc_of_any_capture_time(time_ns):
    assert len(units.utc(time_ns)) == 26
