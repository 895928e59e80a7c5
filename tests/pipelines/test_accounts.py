"""The ledger against plain Python: on any rows, cut into batches anywhere, and on the real captures."""

import math
import struct
from itertools import pairwise
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.mission import Mission
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.info import inspect
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.sequence import SequenceTracker

UNSET = int(Finding.SEQUENCE_UNSET)
LINKS = {1: "ci", 2: "to", 3: "sbn", 0: "other"}


def judge(rows):
    """What ``info`` must say of rows, counted one by one."""
    streams = {}
    for row in rows:
        key = (LINKS[row.link], row.processor_id, row.msg_id, row.sbn_msg_type)
        streams.setdefault(key, []).append(row)
    return {key: judge_stream(stream) for key, stream in streams.items()}


def judge_stream(rows):
    times = [row.time_ns for row in rows]
    intervals = [(after - before) / 1e9 for before, after in pairwise(times)]
    span = (times[-1] - times[0]) / 1e9
    mean = math.fsum(intervals) / len(intervals) if intervals else 0.0
    jitter = (
        math.sqrt(math.fsum((item - mean) ** 2 for item in intervals) / len(intervals)) if intervals else 0.0
    )
    counted = [row for row in rows if row.msg_id != NO_MSG_ID and not row.findings & UNSET]
    senders = {}
    for row in counted:
        senders.setdefault(row.port, SequenceTracker()).follow(row.sequence, row.sequence)
    moving = [item for item in senders.values() if item.moved]
    return {
        "count": len(rows),
        "rate_hz": (len(rows) - 1) / span if span > 0 else 0.0,
        "jitter_ms": jitter * 1e3 if len(rows) > 2 else 0.0,
        "gaps": sum(item.gaps for item in senders.values()),
        "duplicates": sum(item.duplicates for item in moving),
        "reordered": sum(item.reordered for item in moving),
        "bytes": sum(row.length for row in rows),
        "bytes_min": min(row.length for row in rows),
        "bytes_max": max(row.length for row in rows),
    }


def kept(ledger):
    """What a ledger holds, in the judge's words."""
    rows = ledger.routes()
    accounts = ledger.accounts.values()
    by_key = {
        (account.link.label, account.processor_id, account.msg_id, account.sbn_msg_type): None
        for account in accounts
    }
    assert len(by_key) == len(rows)
    found = {}
    for account in sorted(
        accounts, key=lambda item: (item.route < 0, item.link == 0, item.link, item.msg_id, item.processor_id)
    ):
        found[account.link.label, account.processor_id, account.msg_id, account.sbn_msg_type] = rows[
            len(found)
        ]
    return found


def check(found, wanted):
    assert found.keys() == wanted.keys()
    for key, figures in wanted.items():
        for name, value in figures.items():
            exact = name not in {"rate_hz", "jitter_ms"}
            # Shown with three decimals.
            assert found[key][name] == (value if exact else pytest.approx(value, abs=1e-3, rel=1e-6)), (
                key,
                name,
            )


def ledger_of(as_batch, rows, cuts=()):
    ledger = Ledger(Mission())
    places = [0, *sorted(cuts), len(rows)]
    for start, end in pairwise(places):
        ledger.add(*as_batch(rows[start:end]))
    return ledger


@st.composite
def some_rows(draw):
    """Rows of a few streams in order of time, mostly counting on, wrapping, repeating, jumping ahead."""
    time_ns = draw(st.integers(0, 2**60))
    sequences = {}
    rows = []
    for _ in range(draw(st.integers(1, 40))):
        time_ns += draw(st.integers(0, 3 * 10**9))
        link, processor, msg_id, kind, port = draw(
            st.sampled_from(
                [
                    (2, 0, 0x827, -1, 40000),
                    (2, 0, 0x827, -1, 40001),
                    (2, 0, 0x828, -1, 40000),
                    (1, 0, 0x1827, -1, 50000),
                    (3, 1, 0x827, 3, 2234),
                    (3, 2, 0x827, 3, 2235),
                    (3, 2**32 - 1, NO_MSG_ID, 0xA0, 2236),
                    (0, 0, NO_MSG_ID, -1, 9),
                ]
            )
        )
        step = draw(st.sampled_from([1, 1, 1, 1, 0, 2, 5, 8191, 8192, 16383]))
        sequence = (sequences.get((link, msg_id, port), draw(st.integers(16380, 16383))) + step) % 16384
        sequences[link, msg_id, port] = sequence
        rows.append(
            SimpleNamespace(
                time_ns=time_ns,
                length=draw(st.integers(0, 1500)),
                port=port,
                link=link,
                sbn_msg_type=kind,
                processor_id=processor,
                msg_id=msg_id,
                sequence=sequence,
                route=-1,
                findings=draw(st.sampled_from([0, 0, 0, UNSET, UNSET | 1 << 3, 1 << 26])),
            )
        )
    return rows


@given(rows=some_rows(), data=st.data())
def test_any_rows_in_any_batches(rows, data, as_batch):
    cuts = data.draw(st.lists(st.integers(0, len(rows)), max_size=6))
    whole, parts = ledger_of(as_batch, rows), ledger_of(as_batch, rows, cuts)
    wanted = judge(rows)
    for ledger in (whole, parts):
        check(kept(ledger), wanted)
        assert ledger.datagrams == len(rows)
        assert (ledger.start_ns, ledger.end_ns) == (rows[0].time_ns, rows[-1].time_ns)
        assert ledger.findings == {
            bit.label: count for bit in Finding if (count := sum(bool(row.findings & bit) for row in rows))
        }
    assert [item["findings"] for item in parts.routes()] == [item["findings"] for item in whole.routes()]


SEQUENCES = [
    ("counts on", [5, 6, 7], (0, 0, 0)),
    ("wraps", [16382, 16383, 0, 1], (0, 0, 0)),
    ("one lost", [5, 7], (1, 0, 0)),
    ("two lost where it wraps", [16383, 2], (2, 0, 0)),
    ("one twice", [5, 6, 6, 7], (0, 1, 0)),
    ("late", [5, 7, 6, 8], (0, 0, 1)),
    ("half the range is a step ahead", [0, 8191], (8190, 0, 0)),
    ("half the range and one is a step back", [0, 8192], (0, 0, 1)),
    ("a count that never moves is none", [0, 0, 0, 0], (0, 0, 0)),
]


@pytest.mark.parametrize(
    ("counts", "wanted"), [case[1:] for case in SEQUENCES], ids=[case[0] for case in SEQUENCES]
)
def test_sequences(counts, wanted, as_batch, row):
    rows = [row(time_ns=index, sequence=count) for index, count in enumerate(counts)]
    for cuts in ((), range(len(rows))):
        (found,) = ledger_of(as_batch, rows, cuts).routes()
        assert (found["gaps"], found["duplicates"], found["reordered"]) == wanted


def test_two_senders_of_one_msg_id_count_each_for_itself(as_batch, row):
    """Two cFS send the same telemetry to one ground, each with a sequence count of its own."""
    rows = [
        row(time_ns=index, port=40000 + index % 2, sequence=100 * (index % 2) + index // 2)
        for index in range(20)
    ]
    for cuts in ((), (7,), range(20)):
        (found,) = ledger_of(as_batch, rows, cuts).routes()
        assert (found["count"], found["gaps"], found["duplicates"], found["reordered"]) == (20, 0, 0, 0)


def test_figures_of_an_empty_ledger_and_of_one_datagram(as_batch, row):
    empty = Ledger(Mission())
    empty.add(*as_batch([]))
    assert (empty.datagrams, empty.routes()) == (0, [])
    (found,) = ledger_of(as_batch, [row(time_ns=5)]).routes()
    assert (found["rate_hz"], found["jitter_ms"], found["count"]) == (0.0, 0.0, 1)


def plain_rows(path):
    """The datagrams of a capture with what the ledger needs of them, by ports and WIRE alone."""
    data = path.read_bytes()
    place = 24
    while place < len(data):
        seconds, microseconds, size, _ = struct.unpack_from("<IIII", data, place)
        frame = data[place + 16 : place + 16 + size]
        place += 16 + size
        source, destination, length = struct.unpack_from(">HHH", frame, 34)
        payload = frame[42 : 34 + length]
        sbn_ports = {2234, 2235, 2236}
        link = 3 if {source, destination} <= sbn_ports else {1234: 1, 1235: 2}.get(destination, 0)
        kind, processor, packet = -1, 0, payload
        if link == 3 and len(payload) >= 11:
            kind, processor = struct.unpack_from(">BI", payload, 2)
            packet = payload[11:] if kind == 3 else b""
        elif link in {0, 3}:
            packet = b""
        msg_id, word = struct.unpack_from(">HH", packet) if len(packet) >= 6 else (NO_MSG_ID, 0)
        yield SimpleNamespace(
            time_ns=seconds * 10**9 + microseconds * 1000,
            length=len(payload),
            port=source,
            link=link,
            sbn_msg_type=kind,
            processor_id=processor,
            msg_id=msg_id,
            sequence=word & 0x3FFF,
            findings=UNSET if msg_id != NO_MSG_ID and word == 0 else 0,
        )


@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_real_captures(name, captures):
    report = inspect(open_files([captures(name)]), Settings().workbench())
    check(kept(report.ledger), judge(list(plain_rows(captures(name)))))
    assert report.failure is None
