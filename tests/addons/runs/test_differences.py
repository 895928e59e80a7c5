"""Two runs: what is worse, what is only different."""

from __future__ import annotations

import copy

import pytest
from msgspec.structs import replace

from edoras_tools.addons.runs.differences import DifferenceLimits, RunSummary, compare_runs

ROUTE = {
    "topic": "/pose",
    "type": None,
    "name": None,
    "link": "to",
    "processor_id": None,
    "msg_id": "0x0827",
    "count": 100,
    "rate_hz": 10.0,
    "bytes_min": 116,
    "bytes_max": 116,
    "findings": {"stale_tail": 3},
}
ACCOUNT = {
    "link": "to",
    "msg_id": "0x0827",
    "sent": 100,
    "seen": 100,
    "rate_hz": 10.0,
    "crossings": [],
    "delay": {"p50_ms": 5.0, "p99_ms": 20.0, "max_ms": 21.0},
    "to_robot": None,
}
BALANCE = {"link": "to", "msg_id": "0x0827", "lost": 0, "superseded": 0, "unaccounted": 0}
VERDICT = {
    "rule": "no_subscriber",
    "severity": "error",
    "link": "ci",
    "msg_id": "0x18ee",
    "hop": None,
    "topic": None,
    "reason": "nobody takes it",
}


def run(route=(), account=(), verdicts=(), seconds=10.0, balance=()):
    info = {"source": "x.pcap", "datagrams": 100, "routes": [{**copy.deepcopy(ROUTE), **dict(route)}]}
    doctor = {"start_ns": 0, "end_ns": int(seconds * 1e9), "routes": [{**ACCOUNT, **dict(account)}]}
    rows = [{**BALANCE, **dict(balance)}]
    return RunSummary(info, {**doctor, "verdicts": list(verdicts), "balance": rows, "lost": 0})


def changes(good, bad):
    found = compare_runs([good], [bad], DifferenceLimits())
    return [(item.what, item.worse) for item in found if item.differs]


def test_runs_are_no_worse_than_themselves():
    assert changes(run(), run()) == []
    many = [run(account={"rate_hz": 9.0}), run(balance={"lost": 3})]
    assert not any(item.differs for item in compare_runs(many, many, DifferenceLimits()))


def test_a_longer_run_of_the_same_rate_is_the_same():
    assert changes(run(), run(route={"count": 1000}, seconds=100.0)) == []


def test_a_route_that_lasts_for_a_part_of_the_run_only_is_worse():
    """Its rate is that of the time in which it came."""
    assert changes(run(), run(route={"count": 1000}, seconds=400.0)) == [("route", True)]
    assert changes(run(seconds=40.0), run(seconds=40.0)) == []
    assert changes(run(), run(seconds=15.0)) == []


CASES = [
    ({"account": {"rate_hz": 8.0}}, [("rate_hz", True)]),
    ({"account": {"rate_hz": 12.0}}, [("rate_hz", False)]),
    ({"account": {"rate_hz": 9.5}}, []),
    ({"account": {"rate_hz": 2.0}, "route": {"count": 4}}, []),
    ({"account": {"delay": {"p99_ms": 99.0}, "seen": 19}}, []),
    ({"balance": {"lost": 1}, "account": {"sent": 4}}, [("lost", False)]),
    ({"balance": {"lost": 1}}, [("lost", True)]),
    ({"balance": {"superseded": 40}}, [("superseded", True)]),
    ({"balance": {"unaccounted": 1}}, [("unaccounted", True)]),
    ({"balance": {"link": None, "msg_id": None, "lost": 3}}, [("lost", True)]),
    ({"account": {"delay": {"p99_ms": 31.0}}}, [("latency_ms", True)]),
    ({"account": {"delay": {"p99_ms": 29.0}}}, []),
    ({"account": {"delay": None}}, []),
    ({"account": {"to_robot": {"p99_ms": 31.0}}}, [("latency_ms", True)]),
    ({"route": {"bytes_max": 136}}, [("bytes", False)]),
    ({"route": {"findings": {}}}, [("finding", False)]),
    ({"route": {"findings": {"stale_tail": 1, "length_mismatch": 1}}}, [("finding", True)]),
    ({"route": {"findings": {"stale_tail": 1, "sequence_unset": 1}}}, [("finding", False)]),
    ({"verdicts": [VERDICT]}, [("verdict", True)]),
    ({"verdicts": [{**VERDICT, "severity": "note"}]}, [("verdict", False)]),
    ({"route": {"msg_id": "0x0828"}}, [("route", True), ("route", False)]),
]


@pytest.mark.parametrize(("bad", "expected"), CASES)
def test_each_change(bad, expected):
    assert changes(run(), run(**bad)) == expected


@pytest.mark.parametrize(("bad", "expected"), [item for item in CASES if item[0].get("verdicts")])
def test_what_went_is_only_told(bad, expected):
    assert changes(run(**bad), run()) == [(what, False) for what, _ in expected]


def test_loss_that_grew_a_little_is_no_news():
    def lossy(lost):
        return run(account={"sent": 1000}, balance={"lost": lost})

    assert changes(lossy(500), lossy(505)) == []
    assert changes(lossy(500), lossy(530)) == [("lost", True)]
    assert changes(lossy(500), lossy(300)) == [("lost", False)]


@pytest.mark.parametrize(("before", "after", "worse"), [(25, 32, []), (25, 34, [("lost", True)])])
def test_a_loss_of_one_run_is_worse_beyond_the_spread_of_the_earlier_one(before, after, worse):
    key = ROUTE["link"], ROUTE["msg_id"], 1
    good, bad = (
        replace(run(account={"sent": 163}, balance={"lost": lost}), spreads={key: spread})
        for lost, spread in ((before, 2.4), (after, 7.0))
    )
    assert changes(good, bad) == worse


def test_a_verdict_at_another_place_is_the_same_one():
    assert changes(run(verdicts=[VERDICT]), run(verdicts=[{**VERDICT, "hop": "elsewhere"}])) == []


def test_events_have_no_rate():
    good, bad = run(route={"msg_id": "0x0808"}), run(route={"msg_id": "0x0808", "count": 7})
    assert changes(good, bad) == []
