"""The follower of CFDP transactions, beside a model that keeps every byte."""

from collections import Counter
from itertools import pairwise

import numpy as np
from effort import examples
from fastcrc import crc32
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from pdus import eof, finished, metadata, nak, pdu, piece

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.addons.cfdp import transactions as follower
from edoras_tools.addons.cfdp.link import Checksum, Directive
from edoras_tools.addons.cfdp.transactions import FileEvidence
from edoras_tools.model import PacketBatch
from edoras_tools.sessions import ranges as known_ranges
from edoras_tools.sessions.ranges import KnownRanges

ENDS = 40000, 5222


FINISHED = finished()


def batch_of(payloads, begin_ns=0, step_ns=1000):
    """Make a batch; what travels back has the ports the other way round."""
    length = np.array([len(item) for item in payloads], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    back = np.array([len(item) > 0 and item[0] >> 3 & 1 for item in payloads], bool)
    zero, count = np.zeros(len(payloads), np.int64), len(payloads)
    return PacketBatch(
        data=np.frombuffer(b"".join(payloads) or b"\0", np.uint8),
        number=np.arange(count),
        time_ns=begin_ns + np.arange(count) * step_ns,
        link_type=zero.astype(np.uint16),
        frame_offset=offset,
        frame_length=length,
        original_length=length,
        offset=offset,
        length=length,
        source_address=np.full(count, 0x7F000001, np.uint32),
        source_port=np.where(back, *ENDS[::-1]).astype(np.uint16),
        destination_address=np.full(count, 0x7F000001, np.uint32),
        destination_port=np.where(back, *ENDS).astype(np.uint16),
        ip_version=np.full(count, 4, np.uint8),
        capture_findings=zero.astype(np.uint32),
    )


def follow(payloads, kept=None, **how):
    def keep(item, offset, data):
        kept.setdefault(item.name, {}).update(zip(range(offset, offset + len(data)), data, strict=True))

    made = FileEvidence(keep if kept is not None else None)
    made.take(batch_of(payloads, **how), np.arange(len(payloads)))
    return made.transactions


def test_a_transfer_with_a_loss_and_a_resend():
    content = bytes(range(100))
    kept = {}
    lost = [metadata(100), piece(0, content[:40]), piece(60, content[60:]), eof(content), nak((40, 60))]
    (found,) = follow(lost, kept)
    assert (found.state, found.holes, found.checksum_right) == ("not finished", [(40, 60)], None)
    (found,) = follow([*lost, piece(40, content[40:60]), piece(40, content[40:60]), FINISHED], kept)
    assert (found.segments, found.resent, found.filled, found.naks) == (4, 1, 1, 1)
    assert (found.state, found.complete, found.checksum_right) == ("finished", True, True)
    assert bytes(kept["1:7"][at] for at in range(100)) == content
    (found,) = follow([*lost, piece(40, bytes(20)), FINISHED], kept)
    assert found.checksum_right is False


def test_how_a_transaction_ends():
    content = b"file"
    sent = [metadata(4), piece(0, content)]
    ends = {
        "cancelled": pdu(Directive.EOF, condition_code=15, file_size=4),
        "file checksum failure": finished(5),
        "inactivity detected": finished(8),
        "not finished": eof(content),
        "finished": FINISHED,
    }
    assert [follow([*sent, end])[0].state for end in ends.values()] == [*ends]
    one = [item[:0] + bytes([item[0] | 4]) + item[1:] for item in (*sent, eof(content))]
    assert follow(one)[0].state == "finished", "class 1 ends with EOF"
    assert follow(one[:2])[0].state == "not finished"


def test_a_sequence_number_that_comes_again_is_another_transaction():
    once = [metadata(1), piece(0, b"a"), eof(b"a"), FINISHED]
    found = follow([*once, metadata(2, b"y"), piece(0, b"bc"), eof(b"bc"), FINISHED])
    assert [(item.destination_file_name, item.file_size, item.state) for item in found] == [
        ("x", 1, "finished"),
        ("y", 2, "finished"),
    ]


def test_the_longest_silence():
    assert follow([metadata(4), piece(0, b"a"), piece(1, b"b")], step_ns=5)[0].silence_ns == 5


def test_transactions_and_ranges_are_limited(monkeypatch):
    monkeypatch.setattr(follower, "MOST_TRANSACTIONS", 3)
    monkeypatch.setattr(known_ranges, "MOST_RANGES", 5)
    made = FileEvidence()
    many = [piece(9, b"x", number=number) for number in range(10)]
    made.take(batch_of(many), np.arange(10))
    assert (len(made.transactions), made.left_out) == (3, 7)
    (scattered,) = follow([piece(10 * at, b"x") for at in range(50)])
    assert len(list(scattered.received)) == 5
    assert scattered.segments == 50


def test_offsets_at_the_end_of_their_range_take_no_memory():
    (found,) = follow([piece((1 << 31) - 1, b"x"), piece((1 << 32) - 1, b"x")])
    assert found.received.end == 1 << 32
    (found,) = follow([piece((1 << 64) - 1, b"x" * 9, large=True), piece(1 << 60, b"x", large=True)])
    assert found.received.size == 0


class Transfers(RuleBasedStateMachine):
    """One file, in pieces that come as they come; the model is a set of bytes."""

    @initialize(size=st.integers(1, 60))
    def begin(self, size):
        self.content = bytes(at * 7 % 251 for at in range(size))
        self.kept, self.known, self.end = {}, set(), 0
        self.counts = Counter()
        self.follower = FileEvidence(self.keep)
        self.take([metadata(size)])

    def keep(self, _, offset, data):
        for at, value in enumerate(data, offset):
            assert at not in self.kept, "each byte is handed on once"
            self.kept[at] = value

    def take(self, payloads):
        self.follower.take(batch_of(payloads), np.arange(len(payloads)))

    @rule(
        spans=st.lists(st.tuples(st.integers(0, 59), st.integers(1, 20)), min_size=1, max_size=6),
        in_order=st.booleans(),
    )
    def pieces(self, spans, in_order):
        if in_order:  # pieces that follow each other are taken together
            first = spans[0][0]
            spans = [(first + 5 * number, 5) for number in range(len(spans))]
        payloads = []
        for start, size in spans:
            data = self.content[start : start + size]
            new = set(range(start, start + len(data))) - self.known
            if not data:
                continue
            self.counts["segments"] += 1
            self.counts["resent"] += not new
            self.counts["filled"] += bool(new) and start < self.end
            self.known |= new
            self.end = max(self.known) + 1
            payloads.append(piece(start, data))
        self.take(payloads)

    @rule()
    def end_of_file(self):
        self.take([eof(self.content)])

    @rule(data=st.binary(max_size=30))
    def noise(self, data):
        before = len(self.follower.transactions)
        self.take([data[:0] + bytes([0xE0]) + data, nak((0, 5))])
        self.follower.transactions[before:] = []

    @invariant()
    def agrees(self):
        found = self.follower.transactions[0]
        assert self.kept == {at: self.content[at] for at in self.known}
        assert found.received.size == len(self.known)
        holes = {at for start, end in found.holes for at in range(start, end)}
        assert holes == set(range(len(self.content))) - self.known
        assert {name: getattr(found, name) for name in ("segments", "resent", "filled")} == {
            name: self.counts[name] for name in ("segments", "resent", "filled")
        }
        if found.complete:
            assert found.checksum_right


Transfers.TestCase.settings = settings(max_examples=examples(60), stateful_step_count=12, deadline=None)
test_any_order_of_pieces = Transfers.TestCase


@settings(max_examples=examples(100))
@given(st.lists(st.tuples(st.integers(0, 80), st.integers(1, 20)), max_size=20))
def test_ranges_are_those_of_a_set(spans):
    ranges, known = KnownRanges(), set()
    for start, size in spans:
        new = {at for first, end in ranges.missing(start, start + size) for at in range(first, end)}
        assert new == set(range(start, start + size)) - known
        assert ranges.add(start, start + size)
        known |= new
    found = list(ranges)
    assert {at for start, end in found for at in range(start, end)} == known
    assert all(first[1] < second[0] for first, second in pairwise(found))


@settings(max_examples=examples(100))
@given(st.lists(st.binary(max_size=40) | st.sampled_from([FINISHED, nak((0, 9)), metadata(9)]), max_size=10))
def test_nothing_makes_it_raise(payloads):
    follow(payloads, {})


PEERS = {
    Checksum.CRC_32: crc32.iso_hdlc,
    Checksum.CRC_32C: crc32.iscsi,
    Checksum.MODULAR: lambda content: cfdp.modular_checksum(content, 0),
}


@given(st.sampled_from(list(PEERS)), st.binary(max_size=90), st.data())
def test_checksums_of_each_type_in_any_order(kind, content, data):
    """Pieces and Metadata in any order, pieces also twice; beside a library of its own."""
    ends = sorted({0, len(content), *data.draw(st.lists(st.integers(0, len(content)), max_size=5))})
    sent = [piece(first, content[first:end]) for first, end in pairwise(ends)]
    sent += data.draw(st.lists(st.sampled_from(sent), max_size=3)) if sent else []
    right = PEERS[kind](content)
    wrong = data.draw(st.booleans())
    sent += [metadata(len(content), checksum_type=kind), eof(content, checksum=right ^ wrong)]
    (found,) = follow(data.draw(st.permutations(sent)))
    assert (found.complete, found.checksum_right) == (True, not wrong)


def test_a_type_that_is_not_known_is_never_called_wrong():
    for kind in (1, 9, Checksum.NULL):
        (found,) = follow([metadata(4, checksum_type=kind), piece(0, b"file"), eof(b"file", checksum=7)])
        assert (found.complete, found.checksum_type, found.checksum_right) == (True, kind, None)
    (found,) = follow([piece(0, b"file"), eof(b"file", checksum=7)])
    assert (found.checksum_type, found.checksum_right) == (None, None)
