from __future__ import annotations

import io

import pytest
from rich.console import Console

from edoras_tools.render.sending import replay

PLAN = {
    "to": "ci",
    "target": "127.0.0.1:1234",
    "listen": "127.0.0.1:1235",
    "sender": None,
    "wait_for": ["to-enabled"],
    "datagrams": 1200,
    "rate_asked_hz": 30.0,
    "routes": [{"msg_id": "0x1827", "topic": "/cmd_vel", "count": 600}],
    "faults": ["drop:0.1"],
    "notes": ["cut"],
}
OUTCOME = {
    "sent": 601,
    "rate_asked_hz": 9.693,
    "rate_achieved_hz": 9.69,
    "duration_s": 61.9,
    "lateness_us": {"p50": 1.0, "p99": 34.6, "max": 3711.0},
    "send_errors": 2,
    "errors": {"Connection refused": 2},
    "faults": {"drop": 3, "delay": 1},
    "interrupted": False,
    "notes": [],
    "ingest": {"state": "missing", "sent": 601, "read": 589, "missing": 12},
    "seen": {
        "events": [
            {
                "app": "CFE_SB",
                "event_id": 17,
                "event_type": "error",
                "message": "Msg Limit Err [bold]\x1b[31m",
                "count": 16,
            }
        ],
        "counters": {"message_limit_error_counter": {"first": 0, "last": 96, "gained": 96}},
        "telemetry": [
            {"link": "to", "msg_id": "0x0827", "topic": "/telemetry_pose", "name": None, "count": 63}
        ],
        "sbn": {"PROTO": 1},
    },
}


def printed(view, width=100):
    console = Console(file=io.StringIO(), width=width, markup=False, emoji=False, highlight=False)
    console.print(view)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_what_would_be_sent():
    assert printed(replay.plan(PLAN)) == [
        "would send  1,200 datagrams to ci at 127.0.0.1:1234",
        "rate        30.0 Hz",
        "listening   at 127.0.0.1:1235",
        "waits for   to-enabled",
        "fault       drop:0.1",
        "note        cut",
        "",
        "MsgId   Topic     Count",
        "0x1827  /cmd_vel    600",
    ]


def test_what_would_be_sent_without_end_as_a_peer():
    lines = printed(replay.plan({**PLAN, "datagrams": None, "sender": "66:3", "rate_asked_hz": None}))
    assert "would send  without end to ci at 127.0.0.1:1234" in lines
    assert "rate        as fast as it goes" in lines
    assert "listening   at 127.0.0.1:1235 as 66:3" in lines


def test_what_came_of_it():
    lines = printed(replay.outcome(OUTCOME, "127.0.0.1:1234"))
    assert lines == [
        "sent      601 datagrams to 127.0.0.1:1234 over 61.9 s",
        "rate      9.7 Hz, asked: 9.7 Hz",
        "lateness  p50 1.0 µs  p99 34.6 µs  max 3.71 ms",
        "not sent  2: Connection refused",
        "faults    delay 1, drop 3",
        "read      589 of 601 by Command Ingest; 12 never came to it: its socket was full, or they were lost",
        "          on the way",
        "counter   message_limit_error_counter 0 → 96",
        "event     CFE_SB 17: Msg Limit Err [bold]\\x1b[31m  x16",
        "SBN       PROTO 1",
        "",
        "Link  MsgId   Topic            Count",
        "TO    0x0827  /telemetry_pose     63",
    ]


def test_nothing_came_back():
    empty = {"events": [], "counters": {}, "telemetry": [], "sbn": {}, "answers": 0}
    late = dict.fromkeys(("p50", "p99", "max"))
    summary = {
        **OUTCOME,
        "seen": empty,
        "ingest": None,
        "lateness_us": late,
        "errors": {},
        "faults": {},
        "rate_achieved_hz": None,
        "duration_s": 0.0,
        "sent": 1,
        "interrupted": True,
    }
    assert printed(replay.outcome(summary, "there")) == ["sent  1 datagram to there  (ended early)"]


@pytest.mark.parametrize(
    ("state", "read", "words"),
    [
        ("all", 601, ["all 601 by Command Ingest"]),
        (
            "waiting",
            233,
            ["233 of 601 by Command Ingest when listening ended; the others may wait in its socket"],
        ),
        (
            "partly",
            591,
            ["at least 591 of 601 by Command Ingest; the others were sent before its count was known"],
        ),
        ("others", None, ["Command Ingest also read what others sent: its count shows nothing"]),
        ("restarted", None, ["Command Ingest's count began anew: it shows nothing"]),
        ("unknown", None, []),
    ],
)
def test_what_command_ingest_has_read(state, read, words):
    summary = {**OUTCOME, "ingest": {"state": state, "sent": 601, "read": read, "missing": None}}
    lines = printed(replay.outcome(summary, "there"), width=120)
    assert [line.removeprefix("read      ") for line in lines if line.startswith("read ")] == words


def test_many_events_are_cut():
    event = OUTCOME["seen"]["events"][0]
    seen = {**OUTCOME["seen"], "events": [event] * 25}
    assert "event     and 5 more" in printed(replay.outcome({**OUTCOME, "seen": seen}, "there"))
