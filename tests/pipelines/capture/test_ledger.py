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
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.workbench import Settings, open_files

UNSET = int(Finding.SEQUENCE_UNSET)
LINKS = {1: "ci", 2: "to", 3: "sbn", 4: "robot", 0: "other"}


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
    return {
        "count": len(rows),
        "rate_hz": (len(rows) - 1) / span if span > 0 else 0.0,
        "jitter_ms": jitter * 1e3 if len(rows) > 2 else 0.0,
        "bytes": sum(row.length for row in rows),
        "bytes_min": min(row.length for row in rows),
        "bytes_max": max(row.length for row in rows),
    }


def kept(ledger):
    """What a ledger holds, in the judge's words."""
    rows = ledger.routes()
    accounts = ledger.accounts.values()
    by_key = {
        (account.link.label, account.processor_id, account.msg_id, account.kind): None for account in accounts
    }
    assert len(by_key) == len(rows)
    found = {}
    for account in sorted(
        accounts, key=lambda item: (item.route < 0, item.link == 0, item.link, item.msg_id, item.processor_id)
    ):
        found[account.link.label, account.processor_id, account.msg_id, account.kind] = rows[len(found)]
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
    for name in ("findings", "gaps", "duplicates", "reordered"):
        assert [item[name] for item in parts.routes()] == [item[name] for item in whole.routes()]


def test_two_senders_of_one_msg_id_count_each_for_itself(as_batch, row):
    """Two cFS send the same telemetry to one ground, each with a sequence count of its own."""
    rows = [
        row(time_ns=index, port=40000 + index % 2, sequence=100 * (index % 2) + index // 2)
        for index in range(20)
    ]
    for cuts in ((), (7,), range(20)):
        (found,) = ledger_of(as_batch, rows, cuts).routes()
        assert (found["count"], found["gaps"], found["duplicates"], found["reordered"]) == (20, 0, 0, 0)


@pytest.mark.parametrize(
    ("times_ms", "behind", "behind_ms"),
    [
        ((0, 10, 20, 30), 0, 0),
        ((0, 20, 10, 30), 1, 10),
        ((10, 30, 0, 20), 1, 30),
        ((30, 20, 10, 0), 3, 30),
        ((0, 300, 10, 20), 1, 290),
    ],
)
def test_datagrams_behind_later_ones_are_told(as_batch, row, times_ms, behind, behind_ms):
    rows = [row(time_ns=time * 10**6, sequence=at) for at, time in enumerate(times_ms)]
    for cuts in ((), (1,), (2,), (3,), (1, 2, 3)):
        ledger = ledger_of(as_batch, rows, cuts)
        assert (ledger.behind, ledger.behind_ns) == (behind, behind_ms * 10**6)
        assert [line.split(":")[0] for line in ledger.notes] == [
            f"times run back at {behind} datagram{'s' * (behind > 1)}, by up to {behind_ms / 1000:.3f} s"
        ] * bool(behind)
        (found,) = ledger.routes()
        assert found["rate_hz"] == pytest.approx(3e3 / (max(times_ms) - min(times_ms)), abs=1e-3)


def test_microseconds_behind_are_not_told(as_batch, row):
    ledger = ledger_of(as_batch, [row(time_ns=time) for time in (0, 50_000, 40_000, 90_000)])
    assert (ledger.behind, ledger.behind_ns, ledger.notes) == (1, 10_000, [])


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
            forms = [(8585, 48), (8585, 56), (8080, 64)]
            if (destination, len(payload)) in forms:
                link, kind = 4, forms.index((destination, len(payload)))
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
