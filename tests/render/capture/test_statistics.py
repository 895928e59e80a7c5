"""Tables of counts."""

from io import StringIO

from rich.console import Console

from edoras_tools.render.capture.info import STATISTICS, statistics

ROUTE = {
    "topic": "/cmd_vel",
    "type": "geometry_msgs/msg/Twist",
    "link": "ci",
    "msg_id": "0x1827",
    "count": 3,
    "rate_hz": 10.0,
    "bytes": 230,
    "bytes_min": 76,
    "bytes_max": 78,
    "findings": {},
}
STREAM = {
    "source": "SBN 66:1",
    "destination": "SBN 66:3",
    "message": "HEARTBEAT",
    "count": 7,
    "runs": 2,
    "period_ms": 9000.0,
    "first_ns": 11_804_000_000,
    "last_ns": 89_026_000_000,
}
FOUND = {"routes": [ROUTE], "sizes": [ROUTE], "sbn": [STREAM], "findings": {"truncated": 2}}
SAID = {
    "routes": ["/cmd_vel", "10.0 Hz"],
    "sizes": ["76.7", "76", "78", "230 B"],
    "sbn": ["SBN 66:1", "HEARTBEAT", "9.0 s", "11.804 s", "89.026 s"],
    "findings": ["truncated", "20%"],
}


def drawn(kind, width):
    out = StringIO()
    Console(file=out, width=width).print(statistics(kind, FOUND[kind], 10, width))
    return out.getvalue()


def test_every_statistic_has_its_table():
    assert set(STATISTICS) == set(FOUND)
    for kind in STATISTICS:
        for text in SAID[kind]:
            assert text in drawn(kind, 160), (kind, text)


def test_narrow_terminals_lose_columns_not_lines():
    for kind in ("routes", "sizes", "sbn"):
        lines = drawn(kind, 60).splitlines()
        assert len(lines) == 2
        assert all(len(line) <= 60 for line in lines)
