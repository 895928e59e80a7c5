"""Sequence counts as transcripts, and against a plain reference that takes packets one by one."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.model import Finding
from edoras_tools.sessions.sequence import MODULUS, REPEATED, WINDOW, SequenceCounts

SECOND = 10**9
NAMES = ("gaps", "duplicates", "reordered", "restarts")


class Batch(SimpleNamespace):
    """As much of a batch, and of its columns, as following needs; all packets are 8 bytes."""

    def __len__(self):
        return len(self.length)

    @staticmethod
    def fixed(address):
        return address.astype(np.uint64)


def batch_of(packets):
    """Return batch and columns of packets: count, body, boot in s or None, sender, and more."""
    size = len(packets)
    column = {
        name: np.array([packet.get(name, 0) for packet in packets], kind)
        for name, kind in (
            ("count", "u2"),
            ("body", "u8"),
            ("sender", "u2"),
            ("processor", "u4"),
            ("to", "u2"),
        )
    }
    boots = [packet.get("boot") for packet in packets]
    times = np.array([packet.get("time_ns", 100 * SECOND) for packet in packets], np.int64)
    batch = Batch(
        data=np.append(column["body"], np.zeros(16, "u8")).view(np.uint8),
        length=np.full(size, 8, np.int32),
        time_ns=times,
        source_address=np.full(size, 1, np.uint32),
        source_port=column["sender"],
        destination_address=np.full(size, 1, np.uint32),
        destination_port=column["to"],
        ipv6=(),
    )
    columns = SimpleNamespace(
        msg_id=np.array([packet.get("msg_id", 0x827) for packet in packets], np.int32),
        findings=np.array([packet.get("unset", 0) * Finding.SEQUENCE_UNSET for packet in packets], np.uint32),
        link=np.full(size, 2, np.uint8),
        spacecraft=np.ones(size, np.uint8),
        sequence_count=column["count"],
        processor_id=column["processor"],
        spacecraft_id=column["processor"],
        mission_time_ns=np.array(
            [-1 if boot is None else at - int(boot * SECOND) for boot, at in zip(boots, times, strict=True)],
            np.int64,
        ),
        packet_offset=np.arange(size, dtype=np.int64) * 8,
        packet_length=np.full(size, 8, np.int32),
    )
    return batch, columns


def followed(packets, cuts=()):
    """Return the follower and what it said of all rows."""
    counts, edges = SequenceCounts(), [0, *sorted(cuts), len(packets)]
    parts = [counts.follow(*batch_of(packets[a:b])) for a, b in pairwise(edges)]
    return counts, parts


def packets_of(counts, **more):
    """Return packets of one sender with different bodies."""
    return [{"count": count, "body": 1000 + index, **more} for index, count in enumerate(counts)]


def told(packets):
    """Return gaps, duplicates, late packets and restarts of packets of one stream."""
    counts, _ = followed(packets)
    (stream,) = counts.streams
    return stream.gaps, stream.duplicates, stream.reordered, stream.restarts


ONE_SENDER = [
    ("nothing missing", [5, 6, 7], (0, 0, 0, 0)),
    ("two missing", [5, 8, 9], (2, 0, 0, 0)),
    ("over the wrap", [16382, 16383, 0, 1], (0, 0, 0, 0)),
    ("one missing at the wrap", [16383, 1], (1, 0, 0, 0)),
    ("one late", [5, 7, 6, 8], (0, 0, 1, 0)),
    ("late over the wrap", [16382, 0, 16383, 1], (0, 0, 1, 0)),
    ("one of three late", [5, 9, 8, 10], (2, 0, 1, 0)),
    ("one late where many are missing", [40, 100, 41, 101, 102, 103], (58, 0, 1, 0)),
    ("late, and no more", [1, 0], (0, 0, 1, 0)),
    ("late from before the first", [7, 6, 8], (0, 0, 1, 0)),
    ("a block late", [5, 20, *range(6, 20), 21], (0, 0, 14, 0)),
    ("late by more than the window", [5, 3000, 6, 3001], (0, 0, 0, 0)),
    ("half the range is a step ahead", [0, 8191], (8190, 0, 0, 0)),
    ("half the range and one is a step back", [0, 8192], (0, 0, 0, 1)),
    ("begun anew within the window", [500, 501, 502, 1, 2, 3], (0, 0, 0, 1)),
    ("begun anew, two missing", [500, 501, 502, 1, 2, 3, 6], (2, 0, 0, 1)),
    ("begun anew at 0 after many", [9000, 9001, 0, 1, 2], (0, 0, 0, 1)),
    ("begun anew where the first was 0", [*range(300), 0, 1, 2], (0, 0, 0, 1)),
    ("many missing around the wrap", [16000, 300, 301], (683, 0, 0, 0)),
    ("two senders", [100, 40, 101, 41, 102, 42, 103], (0, 0, 0, 0)),
    ("two senders, the other ahead", [40, 100, 41, 101, 42, 102, 43, 103], (0, 0, 0, 0)),
    ("two senders far apart", [100, 5000, 101, 5001, 102], (0, 0, 0, 0)),
    ("two senders far apart, one loses", [100, 5000, 103, 5001, 104], (2, 0, 0, 0)),
    ("a damaged count", [*range(5), 5 + 128, *range(6, 12)], (1, 0, 0, 0)),
    ("three senders", [n + k for k in range(5) for n in (1, 500, 9000)], (0, 0, 0, 0)),
    ("never counts", [7, 7, 7, 7], (0, 0, 0, 0)),
    ("no count at all", [n * n * 7919 % MODULUS for n in range(60)], (0, 0, 0, 0)),
]


@pytest.mark.parametrize(
    ("counts", "expected"), [case[1:] for case in ONE_SENDER], ids=[case[0] for case in ONE_SENDER]
)
def test_transcripts(counts, expected):
    assert told(packets_of(counts)) == expected


def test_equal_bytes_are_duplicates_and_others_are_not():
    packets = packets_of([5, 6, 7, 8])
    assert told([*packets[:2], packets[1], *packets[2:]]) == (0, 1, 0, 0)
    assert told([*packets, packets[1]]) == (0, 1, 0, 0), "repeated later"
    assert told([*packets, {"count": 6, "body": 1}])[1] == 0, "other bytes"
    assert told([packets[0]] * 4) == (0, 0, 0, 0), "what never moves repeats nothing"
    assert told([packet for packet in packets for _ in range(2)]) == (0, 4, 0, 0), "each captured twice"


def test_times_tell_senders_apart():
    """Two processors count one MsgId, and both lose: only their boot times tell what is whose."""
    one, two = packets_of(range(4, 400, 3), boot=10.0), packets_of(range(440, 1232, 6), boot=19.5)
    mixed = [packet for pair in zip(one, two, strict=True) for packet in pair]
    assert told(mixed) == (2 * 131 + 5 * 131, 0, 0, 0)


def test_a_clock_that_is_set_does_not_end_a_count():
    assert told([*packets_of([5, 6], boot=10), *packets_of([7, 8], boot=90)]) == (0, 0, 0, 0)
    assert told([*packets_of([500, 501], boot=10), *packets_of([2, 3], boot=90)]) == (0, 0, 0, 1)


def test_one_that_was_held_back_for_long_still_fills_its_hole():
    """A cFS that stood still sends what waited seconds late, and a capture may put the newest first."""
    held = [*packets_of([9], boot=10), *packets_of([6, 7, 8], boot=13.5), *packets_of([10, 11], boot=10)]
    assert told([*packets_of([4, 5], boot=10), *held]) == (0, 0, 3, 0)


def test_each_sender_and_each_receiver_of_copies_has_a_stream():
    ports = [{"count": n, "body": n, "sender": port} for n in range(4) for port in (1, 2)]
    peers = [{"count": n, "body": n, "processor": 2, "to": port} for n in range(4) for port in (1, 2)]
    moved = [{"count": n, "body": n, "to": n} for n in range(4)]
    assert [len(followed(packets)[0].streams) for packets in (ports, peers, moved)] == [2, 2, 1]
    for packets in (ports, peers, moved):
        assert all((s.gaps, s.duplicates) == (0, 0) for s in followed(packets)[0].streams)


def test_a_word_of_zero_is_no_count():
    counts, (rows,) = followed([{"unset": 1}, {"count": 4}, {"unset": 1}])
    assert (len(counts.streams), rows.stream.tolist()) == (1, [-1, 0, -1])


@given(
    st.integers(0, MODULUS - 1),
    st.integers(2, 600),
    st.randoms(use_true_random=False),
    st.integers(1, 1200),
    st.booleans(),
)
@settings(max_examples=examples(40, 4))
def test_what_comes_late_is_reordered_and_not_missing(start, reach, random, size, timed):
    """Packets each delayed by up to some hundred places: all are there, so none is missing."""
    order = sorted(range(size), key=lambda place: place + random.random() * reach)
    packets = [{"count": (start + n) % MODULUS, "body": n, "boot": 5.0 if timed else None} for n in order]
    highest = np.maximum.accumulate(order)
    assert told(packets) == (0, 0, int((np.array(order) < highest).sum()), 0)


@given(st.integers(0, MODULUS - 1), st.lists(st.integers(0, 20), min_size=1, max_size=60))
def test_of_one_sender_every_loss_is_counted(start, losses):
    places = np.cumsum([0, *(lost + 1 for lost in losses[:-1])])
    assert told(packets_of((start + places) % MODULUS)) == (sum(losses[:-1]), 0, 0, 0)


class Plain:
    """The rules, a packet at a time, with sets of positions; of one stream."""

    def __init__(self):
        self.strands, self.n, self.previous = [], 0, None
        self.gaps = self.duplicates = self.reordered = self.restarts = 0

    def take(self, count, body, boot):
        self.n += 1
        if self.previous == (count, body):
            self.duplicates += 1
            return None
        self.previous = count, body
        mine = [s for s in self.strands if boot is None or s.boot is None or abs(s.boot - boot) <= 3]
        for strand in mine or self.strands:
            if (strand.last + 1) % MODULUS == count:
                strand.go(strand.last + 1, body, boot)
                return self.moved(strand)
        rules = (
            lambda: self.late(mine or self.strands, count, body, boot, missed=True),
            lambda: self.again(mine, count, body),
            lambda: self.ahead(mine, count, body, boot, WINDOW),
            lambda: self.late(mine, count, body, boot, missed=False),
            lambda: self.ahead(mine, count, body, boot, MODULUS // 2),
            lambda: self.begin(PlainStrand(count, body, boot)),
        )
        return any(rule() for rule in rules)

    def moved(self, strand):
        strand.moved, strand.n = True, self.n
        self.strands = [strand, *(s for s in self.strands if s is not strand)]
        for other in self.strands:
            if other.follows is strand:
                other.follows, self.restarts = None, self.restarts - 1

    def begin(self, strand):
        if self.strands:
            strand.follows, self.restarts = self.strands[0], self.restarts + 1
        strand.n = self.n
        self.put(strand)
        return True

    def put(self, strand):
        known = [s for s in self.strands if self.n - s.n <= 4096]
        self.strands = [strand, *known][:8]

    def again(self, mine, count, body):
        for s in mine:
            at = s.position(count)
            if s.last - REPEATED < at <= s.last and s.hole(at) is None:
                if s.bodies.get(at) == body:
                    self.duplicates += 1
                    return True
                if not s.moved and at == s.last:
                    s.bodies[at] = body
                    return True
        return False

    def ahead(self, mine, count, body, boot, reach):
        steps = [(s.position(count) - s.last, index) for index, s in enumerate(mine)]
        steps = [item for item in steps if item[0] > 0]
        if not steps or min(steps)[0] > reach:
            return False
        step, index = min(steps)
        strand = mine[index]
        if step > WINDOW and count < 64 and (boot is None or strand.boot is None):
            return False
        strand.holes.append([strand.last + 1, strand.last + step, True])
        self.gaps += step - 1
        strand.go(strand.last + step, body, boot)
        strand.steps = 0
        self.moved(strand)
        return True

    def late(self, mine, count, body, boot, *, missed):
        for s in mine:
            at = s.position(count)
            hole = s.hole(at)
            if hole is None or hole[2] != missed:
                continue
            first, end, _ = hole
            if at <= s.last - WINDOW:
                if end - first > WINDOW:
                    s.steps = 0
                    self.divide(s, hole, at, body, boot)
                    return True
                continue
            if at <= first + 1 or not missed:
                again = s.steps and at == s.behind
                s.steps, s.front = (s.steps + 1, s.front) if again else (1, 0)
            else:
                s.steps = 0
            s.behind = at + 1
            if s.steps >= 3 and (not missed or s.front >= 2 or end == s.last) and end - at > 16:
                self.divide(s, hole, at, body, boot)
                return True
            s.bodies[at] = body
            s.holes.remove(hole)
            s.holes += [part for part in ([first, at, missed], [at + 1, end, missed]) if part[0] < part[1]]
            self.gaps -= missed
            self.reordered += 1
            return True
        return False

    def divide(self, s, hole, at, body, boot):
        first, end, missed = hole
        back = max(s.steps - 1, 0)
        self.reordered -= back
        s.steps = 0
        other = PlainStrand(at, body, boot)
        other.moved, other.follows = True, s.follows
        other.behind = s.behind
        if not missed:
            other.holes = [[at - back - WINDOW, at - back, False]]
            self.begin(other)
            return
        self.gaps -= end - at
        other.holes = [h for h in s.holes if h[1] <= first]
        other.holes += [[first, at, True]] if first < at else []
        s.holes = [[end - WINDOW, end, False], *(h for h in s.holes if h[0] >= end)]
        other.n = self.n
        self.put(other)
        self.moved(other)


class PlainStrand:
    def __init__(self, at, body, boot):
        self.last, self.boot, self.bodies = at, boot, {at: body}
        self.holes = [[at - WINDOW, at, False]]
        self.follows, self.moved, self.n = None, False, 0
        self.steps = self.front = self.behind = 0

    def position(self, count):
        return min(
            (at for lap in (-1, 0, 1) for at in [(self.last // MODULUS + lap) * MODULUS + count]),
            key=lambda at: (abs(at - self.last), at),
        )

    def hole(self, at):
        return next((hole for hole in self.holes if hole[0] <= at < hole[1]), None)

    def go(self, at, body, boot):
        self.last, self.boot = at, self.boot if boot is None else boot
        self.bodies[at] = body
        self.front += 1
        self.holes.sort()
        while self.holes:
            first, end, _ = self.holes[0]
            if end > self.last - (4096 if end - first > WINDOW else WINDOW):
                break
            del self.holes[0]


@st.composite
def streams(draw):
    """Packets of one stream: runs, jumps, repeats and turns of some senders, with or without times."""
    base = [draw(st.integers(0, MODULUS - 1))]
    base.append((base[0] + draw(st.sampled_from([1, 30, 200, 2000, 9000]))) % MODULUS)
    boots = draw(st.sampled_from([(None, None), (5.0, 5.0), (5.0, 60.0), (5.0, None)]))
    packets, at = [], list(base)
    for _ in range(draw(st.integers(1, 40))):
        who = draw(st.integers(0, 1))
        what = draw(
            st.sampled_from(["run", "run", "lose", "gaps", "back", "repeat", "far", "any", "zero", "same"])
        )
        size = draw(st.integers(1, 6))
        if what == "lose":
            at[who] += size
        if what == "back":
            at[who] -= size * 7
        if what == "far":
            at[who] += size * 900
        if what == "any":
            at[who] = draw(st.integers(0, MODULUS - 1))
        if what == "zero":
            at[who] = 0
        if what == "repeat" and packets:
            packets.append(packets[-min(size, len(packets))])
            continue
        if what == "same":
            at[who] -= 1
        for _ in range(1 if what == "back" else size):
            packets.append({"count": at[who] % MODULUS, "body": draw(st.integers(1, 3)), "boot": boots[who]})
            at[who] += 1 + (what == "gaps") * draw(st.sampled_from([1, 20, 1023]))
        if what == "back":
            at[who] += size * 7
    return packets


@given(streams(), st.data())
@settings(max_examples=examples(200))
def test_any_counts_in_any_batches_are_as_one_by_one(packets, data):
    plain = Plain()
    for packet in packets:
        plain.take(packet["count"], packet["body"], packet["boot"])
    cuts = data.draw(st.lists(st.integers(0, len(packets)), max_size=4))
    for edges in ((), cuts, range(1, len(packets))):
        counts, parts = followed(packets, edges)
        (stream,) = counts.streams
        assert (stream.missing, stream.repeated, stream.late, stream.restarts) == (
            plain.gaps,
            plain.duplicates,
            plain.reordered,
            plain.restarts,
        )
        rows = counts.whole(parts)
        sums = [
            int(column.sum()) for column in (rows.missing, rows.duplicates, rows.reordered, rows.restarts)
        ]
        assert sums == [*(getattr(stream, name) for name in NAMES[:3]), stream.restarts * stream.has_count]
        assert rows.missing.min() >= 0
        assert rows.stream.tolist() == [0 if stream.has_count else -1] * len(packets)
