"""Nothing is quadratic: four times as much of it costs at most six times the processor time.

``make test`` does the smallest sizes that tell; ``make long`` 50,000 of each, which takes less than 5 s, and
whole commands on each input of ``many``, whose memory it measures too.
"""

import random
import struct
import time

import growth
import many
import pytest
from effort import LONG
from streams import SYN, Segment, sbn_messages, write_segments

from edoras_tools.decode import lines
from edoras_tools.io.formats.merge import merge_sources
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.packet_json import PacketTexts
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import Settings

MOST_S = 5
BASE_S = 1_700_000_000


def write_packets(path, packets):
    """Write UDP datagrams to CI's port: the source as a number, and the packet."""
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 101)]
    for place, (source, packet) in enumerate(packets):
        ip = struct.pack(">BBHHHBBHII", 0x45, 0, 28 + len(packet), 0, 0, 64, 17, 0, source, 0x0A000001)
        frame = ip + struct.pack(">HHHH", 30000, 1234, 8 + len(packet), 0) + packet
        seconds, rest = divmod(place, 10_000)
        out += struct.pack("<IIII", BASE_S + seconds, 100 * rest, len(frame), len(frame)), frame
    path.write_bytes(b"".join(out))


def command(msg_id, count):
    return struct.pack(">HHHBB", msg_id, 0xC000 | count & 0x3FFF, 1, 1, 0)


def info(path):
    inspect(open_file(path), Settings().workbench())


def as_json(path):
    source, bench = open_file(path), Settings().workbench()
    texts = PacketTexts(bench.columns.context)
    with reading(source, bench) as loop:
        assert sum(len(texts.of(rows)) for rows in loop)


def segments_behind_holes(path, count):
    """TCP segments in random order, of which every second one is missing."""
    segments, at = [], 1000
    for message in sbn_messages(2 * count):
        segments.append(Segment(at, message))
        at += len(message)
    rest = segments[2::2]
    random.Random(1).shuffle(rest)
    order = [Segment(999, flags=SYN), segments[0], *rest]
    step = 10**9 * BASE_S
    write_segments(path, [item._replace(time_ns=step + 10**6 * n) for n, item in enumerate(order)])
    return info


def pairs(path, count):
    """Packets that all have another MsgId or another source."""
    write_packets(path, ((0x0A010000 + n, command(0x1800 + 7 * n % 2000, n)) for n in range(count)))
    return info


def senders(path, count):
    """Telemetry that all comes from another address: each may be a spacecraft."""
    many.senders(path, count)
    return info


def msg_ids(path, count):
    """Packets of 2,047 MsgIds, none of them known."""
    write_packets(path, ((0x0A000002, command(0x1800 + n % 2047, n)) for n in range(count)))
    return as_json


def files(path, count):
    """Captures of one datagram that are read together."""
    count //= 10
    write_packets(path, [(0x0A000002, command(0x1800, 0))])

    def read(path):
        assert sum(map(len, merge_sources([open_file(path) for _ in range(count)]).batches())) == count

    return read


SIZES = {segments_behind_holes: 2000, pairs: 1500, senders: 1000, msg_ids: 1500, files: 1000}


@pytest.mark.each(2)
@pytest.mark.parametrize("make", SIZES, ids=lambda make: make.__name__)
def test_four_times_as_much_costs_at_most_six_times(make, tmp_path):
    """What is quadratic costs sixteen times as much in each of three tries; a busy machine not in all."""
    small = 12_500 if LONG else SIZES[make]
    works = []
    for count in (small, 4 * small):
        path = tmp_path / f"{count}.pcap"
        works.append((make(path, count), path))
    spent(*works[0])  # to import what is imported late
    tries = ((spent(*works[0]), spent(*works[1])) for _ in range(3))
    assert any(more < max(6 * less, 0.3) and more < MOST_S for less, more in tries)


def spent(work, path):
    """Return the processor time of a piece of work, in s."""
    began = time.process_time()
    work(path)
    return time.process_time() - began


def test_many_msg_ids_are_not_dissected_one_by_one(tmp_path, monkeypatch):
    seen = []

    class Counting(lines.Dissector):
        def dissect(self, datagram):
            seen.append(datagram)
            return super().dissect(datagram)

    monkeypatch.setattr(lines, "Dissector", Counting)
    msg_ids(tmp_path / "x.pcap", 4094)(tmp_path / "x.pcap")
    assert len(seen) < 100


@pytest.mark.long
@pytest.mark.parametrize("case", growth.CASES, ids=str)
def test_commands_are_not_quadratic_and_keep_their_memory(case, tmp_path):
    assert not growth.measure(case, tmp_path).wrong
