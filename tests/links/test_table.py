"""The links that only files of cFS have: stored packets, and entries of a reset log.

The two are told apart by length and kinds, alike in bulk and one by one. Entries get the times when they were
made.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rewriting import Udp, write

from edoras_tools.cfs.time_services import START_S
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.io.formats.cfe import reset_times
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.table import RESETS, STORED
from edoras_tools.wire.cfe import EPOCH_S, EXCEPTION, RESET_COMMAND, RESET_ENTRY

SIZE = RESET_ENTRY.size
POWER_CYCLE, WATCHDOG = 1, 4
BEGIN = START_S


def entry(kind=1, reset=2, subtype=POWER_CYCLE, seconds=1149, text="POWER ON RESET"):
    values = {slot.field.name: 0 for slot in RESET_ENTRY.slots if slot.field.kind == "uint"}
    values |= {"debug": bytes(16), "context": bytes(256), "description": text}
    told = {"entry_type": kind, "reset_type": reset, "reset_subtype": subtype, "seconds": seconds}
    return RESET_ENTRY.emit(values | told)


def read(folder, payload, port=0):
    """Return the link of a datagram, on which both readers agree, and its summary."""
    path = write(folder / "x.pcap", [Udp(10**18, ("10.0.0.1", 0), ("10.0.0.2", port), payload)])
    context = Context()
    (batch,) = open_file(path).batches()
    decoded = Dissector(context).dissect(batch[0])
    columns = ColumnDecoder(context).decode(batch)
    assert columns.link[0] == decoded.link
    assert columns.findings[0] == decoded.findings
    return decoded


@pytest.mark.parametrize(
    ("payload", "port", "link", "text"),
    [
        (entry(), 0, RESETS, "reset log, core: POWER ON RESET"),
        (entry(2, 1, EXCEPTION, 1_001_500, "App stopped"), 0, RESETS, "reset log, application: App stopped"),
        (entry()[:-1], 0, STORED, ""),
        (entry(kind=3), 0, STORED, ""),
        (entry(reset=0), 0, STORED, ""),
    ],
)
def test_an_entry_is_told_by_its_length_and_its_kinds(payload, port, link, text, tmp_path):
    decoded = read(tmp_path, payload, port)
    assert decoded.link == link
    if link == RESETS:
        assert decoded.summary == text
        assert [layer.name for layer in decoded.layers] == ["cfe_reset"]


@given(st.binary(min_size=SIZE - 2, max_size=SIZE + 2))
@example(entry())
@example(b"\x01\0\0\0\x02\0\0\0" + bytes(SIZE - 8))
def test_arbitrary_bytes_are_read_alike_and_raise_nothing(tmp_path_factory, data):
    read(tmp_path_factory.getbasetemp(), data)


def times(*entries):
    rows = np.frombuffer(b"".join(entries), np.uint8).reshape(-1, SIZE)
    time_ns, order = reset_times(rows)
    return [item // 10**9 - EPOCH_S for item in time_ns.tolist()], order.tolist()


RUNNING = [entry(2, 1, EXCEPTION, BEGIN + at) for at in range(5)]
STOPPED = entry(1, 1, RESET_COMMAND, BEGIN + 7)
POWERED, DOG = entry(seconds=5_000_000), entry(1, 1, WATCHDOG, 77)


@pytest.mark.parametrize(
    ("entries", "made", "order"),
    [
        ([POWERED], [BEGIN], [0]),
        ([POWERED, *RUNNING[:2]], [BEGIN, BEGIN, BEGIN + 1], [0, 1, 2]),
        # Nothing says when the watchdog bit: not before the entry in front of it.
        ([POWERED, RUNNING[3], DOG, STOPPED], [BEGIN, BEGIN + 3, BEGIN + 3, BEGIN + 7], [0, 1, 2, 3]),
        ([DOG], [BEGIN], [0]),
        # The ring went round: its oldest entry stands in the middle.
        (
            [RUNNING[3], STOPPED, RUNNING[0], RUNNING[2]],
            [BEGIN + 3, BEGIN + 7, BEGIN, BEGIN + 2],
            [2, 3, 0, 1],
        ),
    ],
)
def test_when_entries_were_made(entries, made, order):
    assert times(*entries) == (made, order)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2**32 - 1),
            st.integers(0, 2**32 - 1),
            st.integers(0, 12),
            st.integers(0, 2**32 - 1),
        ),
        min_size=1,
        max_size=20,
    )
)
def test_whatever_a_log_holds_its_entries_are_ordered_in_time(items):
    rows = np.frombuffer(b"".join(entry(*item) for item in items), np.uint8).reshape(-1, SIZE)
    time_ns, order = reset_times(rows)
    assert sorted(order.tolist()) == list(range(len(items)))
    assert (np.diff(time_ns[order]) >= 0).all()
    assert time_ns.min() >= EPOCH_S * 10**9
