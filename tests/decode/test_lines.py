"""That both ways give the same lines, ``test_agreement`` tests on every packet."""

import random
from collections import Counter
from contextlib import closing

import pytest
from places import CAPTURES, ROOT

from edoras_tools.decode import ColumnDecoder, Context, Dissector, lines
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.lines import PacketLines, line_of
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.mission import load
from edoras_tools.model import concatenate
from edoras_tools.ros import TypeStore


@pytest.fixture(scope="module")
def rows():
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        batch = concatenate(list(source.batches()))
    context = Context()
    return ColumnRows(context, 0, batch, ColumnDecoder(context).decode(batch))


@pytest.mark.each(2)
@pytest.mark.quick("16", "1000")
@pytest.mark.parametrize("size", [1, 7, 16, 1000])
def test_any_number_at_once_gives_the_same(rows, size):
    made = PacketLines(rows.context)
    whole = list(made.of(rows))
    parts = [rows.take(rows.indices()[first : first + size]) for first in range(0, len(rows), size)]
    assert [line for part in parts for line in made.of(part)] == whole
    assert [line.number for line in whole] == rows.batch.number.tolist()


def test_only_what_columns_do_not_tell_is_dissected_and_equal_bytes_once(rows, monkeypatch):
    seen = Counter()

    class Counting(Dissector):
        def dissect(self, datagram):
            seen[datagram.payload] += 1
            return super().dissect(datagram)

    monkeypatch.setattr(lines, "Dissector", Counting)
    made = list(PacketLines(rows.context).of(rows))
    alone = {rows.batch[row].payload for row in (rows.columns.packet_offset < 0).nonzero()[0].tolist()}
    assert len(made) == len(rows) > 1800
    assert seen.keys() == alone
    assert set(seen.values()) == {1}


def _mutilated(seed):
    """Packets of a capture, each cut anywhere or with some byte of it changed."""
    chance = random.Random(seed)
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        batch = concatenate(list(source.batches()))
    sent = []
    for row in range(0, len(batch), 3):
        item = batch[row]
        payload = bytearray(item.payload[: chance.randrange(len(item.payload) + 1)])
        if payload and chance.random() < 0.5:
            payload = bytearray(item.payload)
            payload[chance.randrange(min(len(payload), 48))] = chance.randrange(256)
        sent.append((row * 1000, item.source, item.destination, bytes(payload)))
    return Demux().demux(frames_of(sent))


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_malformed_packets_come_from_columns_too(seed, monkeypatch):
    """And the lines are those of the dissector; hardly any needs it."""
    batch = _mutilated(seed)
    mission = load([ROOT / "samples/missions/rover_ground.yaml"])
    context = Context(mission, TypeStore())
    made = ColumnRows(context, 0, batch, ColumnDecoder(context).decode(batch))
    stopped = [Dissector(context, detail=False).dissect(batch[row]) for row in range(len(batch))]
    cut = {item.datagram.number for item in stopped if item.stop and item.layer("ccsds")}
    dissected = []

    class Counting(Dissector):
        def dissect(self, datagram):
            dissected.append(datagram.number)
            return super().dissect(datagram)

    monkeypatch.setattr(lines, "Dissector", Counting)
    assert list(PacketLines(context).of(made)) == [line_of(item) for item in stopped]
    assert len(cut) > 100
    assert len(cut.intersection(dissected)) < len(cut) / 5
