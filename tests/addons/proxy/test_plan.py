"""Faults of streams: when bytes leave, and which rules are refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.proxy.plan import StreamFaults
from edoras_tools.errors import ConfigError
from edoras_tools.sessions.faults.rules import parse_rule

SECOND = 1_000_000_000


def faults(*texts, to_cfs=True):
    return StreamFaults([parse_rule(text) for text in texts], to_cfs=to_cfs)


@pytest.mark.parametrize(
    ("rules", "came", "left"),
    [
        ([], [0, 5], [0, 5]),
        (["delay:1s"], [0, 2 * SECOND], [SECOND, 3 * SECOND]),
        (["bandwidth:8k"], [0, 0, 5 * SECOND], [SECOND, 2 * SECOND, 6 * SECOND]),
        (
            ["silence:2s,from=1s"],
            [0, SECOND, 2 * SECOND, 4 * SECOND],
            [0, 3 * SECOND, 3 * SECOND, 4 * SECOND],
        ),
        (["delay:1s,until=1s"], [0, SECOND + 5], [SECOND, SECOND + 5]),
        (["delay:1s,to=ground"], [0], [0]),
        (["delay:1s,to=cfs"], [0], [SECOND]),
    ],
)
def test_when_a_thousand_bytes_leave(rules, came, left):
    stream = faults(*rules)
    assert [stream.leave(now, 1000) for now in came] == left


@given(st.lists(st.tuples(st.integers(0, SECOND), st.integers(1, 5000)), max_size=30))
def test_bytes_never_overtake_each_other(steps):
    stream = faults("delay:300ms,until=1s", "bandwidth:100k,from=500ms", "silence:200ms,from=2s,period=3s")
    now, before = 0, 0
    for step, size in steps:
        now += step
        leaves = stream.leave(now, size)
        assert leaves >= max(now, before)
        before = leaves


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        ("drop:0.1", "cannot have this fault"),
        ("corrupt:0.1", "cannot have this fault"),
        ("reorder:0.1", "cannot have this fault"),
        ("duplicate:0.1", "cannot have this fault"),
        ("delay:1s,msg_id=0x1827", "relayed as bytes"),
        ("delay:1s,p=0.5", "no datagrams to choose"),
    ],
)
def test_what_a_stream_cannot_have(rule, says):
    with pytest.raises(ConfigError, match=says):
        faults(rule)
