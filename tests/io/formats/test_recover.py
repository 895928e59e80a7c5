"""Captures and databases damaged on purpose, beside a scan that knows what was in them."""

from __future__ import annotations

import gzip
import random
import struct
from collections import Counter
from operator import itemgetter

import damage
import pytest
from effort import LONG
from places import ROOT, SAMPLES
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.recovery.records import KnownTopics
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.formats.recover import repair, repairable_as

HEADS = {"pcap": ("<8xI", 24, 16), "pcapng": ("<4xI", 0, 0)}
"""Where a record's length is, where the first one begins, and what the length does not count."""
MOST_MISSING = 6
"""Records that a wrong length may cost besides its own: those it covered that look alike."""


def records(kind, data):
    """All packets of a sound file, each as its bytes stand there."""
    form, at, head = HEADS[kind]
    found = []
    while at + 16 <= len(data):
        size = struct.unpack_from(form, data, at)[0] + head
        if kind == "pcap" or data[at : at + 4] == b"\6\0\0\0":
            found.append(data[at : at + size])
        at += size
    return found


def surviving(before, data):
    """Which of these records stand in damaged bytes unchanged, in their order."""
    at, found = 0, Counter()
    for record in before:
        place = data.find(record, at)
        if at <= place < at + 300_000:
            found[record] += 1
            at = place + len(record)
    return found


@pytest.fixture(scope="module")
def wholes(tmp_path_factory):
    """Captures of both kinds: the bytes of several each."""
    paths = [SAMPLES / f"captures/{name}.pcap" for name in ("a_rover", "b_arm_single", "f_sbn_disconnect")]
    made = {"pcap": [path.read_bytes() for path in paths], "pcapng": []}
    for path in paths:
        target, source = tmp_path_factory.mktemp("made") / "a.pcapng", open_file(path)
        sink = PcapngSink(target)
        for batch in source.batches():
            sink.write(batch)
        sink.close()
        made["pcapng"].append(target.read_bytes())
    return made


@pytest.mark.each(2)
@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_damaged_captures(tmp_path, wholes, kind):
    """What stands in the file unchanged is kept, the report counts what is written, and nothing raises."""
    source, target = tmp_path / f"bad.{kind}", tmp_path / f"made.{kind}"
    total = Counter()
    for number in range(1000 if LONG else 16):
        way = list(damage.WAYS)[number % len(damage.WAYS)]
        draw = random.Random(f"{kind} {number}")
        first, second = draw.choice(wholes[kind]), draw.choice(wholes[kind])
        data = bytearray(first)
        two = damage.WAYS[way](data, second, draw)
        data = bytes(data)
        source.write_bytes(data)
        target.unlink(missing_ok=True)
        report = repair(source, target)
        kept = Counter(records(kind, target.read_bytes() if target.exists() else data))
        there = surviving(records(kind, first) + (records(kind, second) if two else []), data)
        assert report.messages == {"packets": kept.total()}
        assert report.whole or report.lost
        total += Counter(files=1, there=there.total(), kept=(there & kept).total())
        total["swallowed"] += (there - kept).total() > MOST_MISSING
    print(f"\n{kind}: {dict(total)}")
    assert total["kept"] > 0.998 * total["there"]
    assert total["swallowed"] <= total["files"] / 100


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_a_capture_without_its_beginning(tmp_path, wholes, kind):
    """Its header is one of Ethernet and microseconds; a compressed one is unpacked."""
    data = wholes[kind][0]
    source, target = tmp_path / f"bad.{kind}.gz", tmp_path / f"made.{kind}"
    source.write_bytes(gzip.compress(bytes(24) + data[24:]))
    report = repair(source, target)
    assert "its header cannot be read: Ethernet, and microseconds, are assumed" in report.reasons
    assert records(kind, target.read_bytes()) == records(kind, data)
    assert repair(target, None).whole


def test_a_section_header_without_its_type_costs_no_packet(tmp_path, wholes):
    """Its byte order can be read, and no interface behind it."""
    data = wholes["pcapng"][0]
    source, target = tmp_path / "bad.pcapng", tmp_path / "made.pcapng"
    source.write_bytes(bytes(8) + data[8:])
    repair(source, target)
    assert records("pcapng", target.read_bytes()) == records("pcapng", data)


@pytest.mark.parametrize(
    "data",
    [
        (SAMPLES / "captures/a_rover.pcap").read_bytes()[:30],
        (ROOT / "docs/pictures/wireshark.png").read_bytes(),
    ],
    ids=["a header alone", "a picture"],
)
def test_what_has_no_record_gives_none(tmp_path, data):
    """Behind an assumed header any bytes look like one record, the file's own header too."""
    (tmp_path / "a.pcap").write_bytes(data)
    with pytest.raises(CaptureError, match="it contains nothing to recover"):
        repair(tmp_path / "a.pcap", tmp_path / "made")


def test_a_capture_of_nothing(tmp_path):
    for name in ("a.pcap", "a.pcapng", "a.db3"):
        (tmp_path / name).write_bytes(bytes(5000))
        assert repairable_as(tmp_path / name) == name[2:]
        with pytest.raises(CaptureError, match="it contains nothing to recover"):
            repair(tmp_path / name, tmp_path / "made")
    assert not (tmp_path / "made").exists()


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """A database of rosbag2 with messages of up to three pages, and what is in it."""
    folder, store = tmp_path_factory.mktemp("bag") / "bag", get_typestore(Stores.ROS2_JAZZY)
    text = store.types["std_msgs/msg/String"]
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = [
            writer.add_connection(f"/chatter_{number}", text.__msgtype__, typestore=store)
            for number in range(3)
        ]
        for number in range(900):
            words = text(data=f"{number} " + "x" * (37 * number % 9000))
            cdr = bytes(store.serialize_cdr(words, text.__msgtype__))
            writer.write(topics[number % 3], 10**18 + number, cdr)
    path = folder / "bag.db3"
    return path.read_bytes(), rows(path)


def rows(path):
    """The messages of a recording, read as any other tool's."""
    from edoras_tools.io.formats.rosbag2.reader import open_rosbag

    bag = open_rosbag(path)
    return [(item.topic, item.time_ns, item.cdr) for item in bag.messages({*bag.topics()})]


def test_damaged_databases(tmp_path, database):
    """Page by page: SQLite stops at the first damaged one."""
    data, before = database
    source, target = tmp_path / "bad.db3", tmp_path / "made.mcap"
    kept = 0
    for number in range(200 if LONG else 6):
        draw, bad = random.Random(number), bytearray(data)
        pages = sorted(draw.sample(range(12, len(data) // 4096), draw.randrange(1, 9)))
        for page in pages:
            bad[4096 * page : 4096 * (page + 1)] = bytes(4096)
        if number % 3 == 0:
            del bad[draw.randrange(len(bad) // 2, len(bad)) :]
        if number % 4 == 0:
            bad[:100] = bytes(100)
        source.write_bytes(bad)
        report = repair(source, target, topics=KnownTopics())
        found = rows(target)
        assert Counter(map(itemgetter(0), found)) == report.messages
        assert {*found} <= {*before}
        assert report.lost
        if number % 3:
            most = sum(bad[at : at + 4096] != data[at : at + 4096] for at in range(0, len(data), 4096))
            assert len(found) >= len(before) - 6 * most
            assert sum(loss.messages for loss in report.losses) in {
                900 - len(found) - end for end in range(9)
            }
        kept += len(found)
    assert kept


def test_a_sound_database_is_left_alone(tmp_path, database):
    source, target = tmp_path / "bag.db3", tmp_path / "made.mcap"
    source.write_bytes(database[0])
    report = repair(source, target)
    assert (report.whole, sum(report.messages.values())) == (True, 900)
    assert not target.exists()


def test_topics_without_a_row_are_numbered(tmp_path, database):
    """Where the page of the topics is gone, only their numbers are known."""
    data, before = database
    source, target = tmp_path / "bad.db3", tmp_path / "made.mcap"
    pages = [data[at : at + 4096] for at in range(0, len(data), 4096)]
    source.write_bytes(b"".join(bytes(4096) if b"/chatter_0" in page else page for page in pages))
    report = repair(source, target)
    assert {*report.messages} == {"/unknown/1", "/unknown/2", "/unknown/3"}
    assert sum(report.messages.values()) > len(before) - 6
