"""Who doubled a datagram: the network, whose receiver gets it twice, or the capture."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rewriting import Udp, write

from edoras_tools.diagnosis.evidence.copies import _by_counts
from edoras_tools.wire import cfe
from tests.support.balance import wrong_rows

SECOND, LATER_NS = 10**9, 300_000
TWICE, CI, TO = range(40, 100, 3), 1234, 1235


def command(number):
    values = struct.pack("<6d", number, *range(5))
    return cfe.emit_command(0x1827, 1, values, sequence_flags=0)


def captured(lab, path, *, by_network, without=(), later_ns=LATER_NS):
    """Return the diagnosis of 100 commands of which some are there twice with one identification."""
    sent = [(lab.start_ns + 5 * SECOND + at * SECOND // 4, at) for at in range(100)]
    again = [(when + later_ns, at) for when, at in sent if at in TWICE]
    arrived = sorted(sent + again * by_network)
    feeds = tuple(((when - lab.start_ns) / SECOND, CI, command(at)) for when, at in arrived)
    items = [
        Udp(when, ("127.0.0.1", 5000), ("127.0.0.1", CI), command(at), 1 + at) for when, at in sent + again
    ]
    for at, item in enumerate(lab.simulate(seconds=35, count=0, feeds=feeds)[0]):
        ends = (item.source.address, item.source.port), (item.destination.address, item.destination.port)
        if ends[1][1] not in without:
            items.append(Udp(item.time_ns, *ends, bytes(item.payload), 1000 + at))
    return lab.read(write(path, sorted(items, key=lambda item: item.time_ns)))


def at_ci(found):
    return max(
        (row for row in found.balance if (row.msg_id, row.hop) == (0x1827, "CI")), key=lambda row: row.came
    )


def test_ci_counted_what_the_network_doubled(lab, tmp_path):
    found = captured(lab, tmp_path / "x.pcap", by_network=True)
    assert (at_ci(found).came, at_ci(found).out) == (121, 121)
    assert len(found.case.prepared.duplicates) == 20
    assert "duplicated" in {item.rule for item in found.verdicts}


@pytest.mark.parametrize("later_ns", [0, LATER_NS])
def test_ci_did_not_count_what_the_capture_doubled(lab, tmp_path, later_ns):
    found = captured(lab, tmp_path / "x.pcap", by_network=False, later_ns=later_ns)
    assert (at_ci(found).came, at_ci(found).out) == (101, 101)
    assert (len(found.case.prepared.duplicates), found.case.prepared.copies) == (0, 20)
    assert (found.lost, found.unaccounted, found.uncertain) == (0, 0, 0)


@pytest.mark.parametrize("by_network", [True, False])
def test_where_nothing_tells_it_is_uncertain(lab, tmp_path, by_network):
    found = captured(lab, tmp_path / "x.pcap", by_network=by_network, without=(TO,))
    row = at_ci(found)
    assert not wrong_rows(found.balance)
    (told,) = [item for item in found.verdicts if item.rule == "duplicated"]
    assert "20 datagrams from 127.0.0.1:5000" in told.reason
    assert "nothing shows" in told.reason
    assert (row.came, row.out, row.uncertain, found.lost) == (121, 101, 20, 0)


@given(
    st.lists(st.tuples(st.integers(1, 400), st.booleans()), min_size=20, max_size=200),
    st.lists(st.integers(0, 2400), min_size=60, max_size=60),
    st.booleans(),
)
def test_counts_never_tell_the_other_way(sent, delays, by_network):
    """Steps in ms between datagrams, which are doubled, and how old each count is when it is seen."""
    times = np.cumsum([step for step, _ in sent]) * (SECOND // 1000)
    twice = np.array([doubled for _, doubled in sent])
    all_ns = np.repeat(times, 1 + twice)
    again = np.concatenate([[False] + [True] * doubled for doubled in twice.tolist()]).astype(bool)
    seen_ns = np.arange(len(delays), dtype=np.int64) * SECOND
    made_ns = seen_ns - np.array(delays, np.int64) * (SECOND // 1000)
    made_ns = np.maximum.accumulate(made_ns)
    read = all_ns if by_network else times
    total = np.searchsorted(read, made_ns)
    vote = _by_counts(all_ns, again, seen_ns, total)
    assert vote >= 0 if by_network else vote <= 0
