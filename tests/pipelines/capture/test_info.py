"""What the recorder counted is what reading the recording counts; where that is not sure, it is read."""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import closing
from itertools import cycle, product, zip_longest
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from children import children
from effort import LONG, examples, long_but
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Metadata
from msgspec.structs import replace
from places import CAPTURES, MISSIONS, ROOT, SAMPLES
from rewriting import datagrams, write

from edoras_tools.decode.columns import Begun
from edoras_tools.errors import CaptureError
from edoras_tools.io import processes
from edoras_tools.io.formats import stream
from edoras_tools.io.formats.mcap import chunks, reader, writer
from edoras_tools.io.formats.mcap.file import record_bytes
from edoras_tools.io.formats.recover import repair
from edoras_tools.io.topics.rows import COUNTS_METADATA_NAME
from edoras_tools.model import Columns, PacketBatch
from edoras_tools.pipelines.capture import info as module
from edoras_tools.pipelines.capture.info import Ahead, inspect
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

SETTINGS = Settings(tuple(sorted(MISSIONS.glob("*rovers*.yaml"))))
GIVEN = Path(os.environ.get("EDORAS_CAPTURES", "/nowhere"))
FILES = {
    path.name.split(".")[0]: path
    for path in [*SAMPLES.glob("rtps/*.pcap.gz"), *CAPTURES.glob("*.pcap*"), *GIVEN.glob("*.pcap")]
}
TOTALS = "datagrams", "start_ns", "end_ns", "behind", "behind_ns"
COUNTED = ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"]
FEW = ["b_arm_single", "f_sbn_disconnect", "cyclone_sender"]


@pytest.fixture(scope="module", autouse=True)
def small():
    """Chunks and batches of tens of KiB: a recording is not read in the batches that it was written in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "CHUNK_BYTES", 32 << 10)
        patch.setattr(reader, "_BATCH_BYTES", 56 << 10)
        yield


def recorded(name, path, **options):
    record(open_files([FILES[name]]), SETTINGS.workbench(), Target(path, **options), by_route=False)
    return path


def answer(paths, settings=Settings(), **options):  # noqa: B008  frozen
    source, bench = open_inputs(paths, settings)
    report = inspect(source, bench, **options)
    return report.summary(), report.failure and str(report.failure), report.unnamed, source.statistics


def compared(paths, monkeypatch, settings=Settings(), **options):  # noqa: B008  frozen
    """Return whether recordings were not read; the answer must be that of reading them."""
    *told, statistics = answer(paths, settings, **options)
    with monkeypatch.context() as patch:
        patch.setattr(reader.McapSource, "recorder_counts", lambda _: "")
        *counted, others = answer(paths, settings, **options)
    assert told == counted
    assert statistics.datagrams == others.datagrams
    return not statistics.frames


@pytest.mark.parametrize("name", long_but(FEW, sorted(FILES)))
def test_the_answer_is_that_of_reading_it_all(name, monkeypatch, tmp_path):
    path = recorded(name, tmp_path / "a.mcap")
    unread = compared([path], monkeypatch)
    assert unread or name not in COUNTED


def test_what_asks_for_a_part_or_reads_otherwise_reads(monkeypatch, tmp_path):
    path = recorded("b_arm_single", tmp_path / "a.mcap")
    for options in (
        {"limits": Limits(count=30)},
        {"limits": Limits(period=Period(0, 9 * SECOND))},
        {"selection": Selection(msg_ids=(0x800,))},
        {"settings": Settings((MISSIONS / "rover_ground.yaml",))},
    ):
        assert not compared([path], monkeypatch, **options), options
    assert compared([path], monkeypatch)


def test_cut_split_and_repaired_recordings_and_several(monkeypatch, tmp_path):
    whole = recorded("f_sbn_disconnect", tmp_path / "a.mcap")
    octets = whole.read_bytes()
    recorded("b_arm_single", tmp_path / "parts.mcap", split_count=300)
    cut, damaged, repaired = (tmp_path / f"{name}.mcap" for name in ("cut", "damaged", "repaired"))
    cut.write_bytes(octets[:-30_000])
    damaged.write_bytes(octets[:60_000] + bytes(9_000) + octets[69_000:])
    assert repair(damaged, repaired).lost
    parts = sorted(tmp_path.glob("parts_*.mcap"))
    for paths in ([cut], parts, parts[:1], [whole, parts[0]], [damaged], [repaired]):
        assert not compared(paths, monkeypatch), paths
    assert compared([whole], monkeypatch)


@pytest.mark.quick("0.3", "0.9")
@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_one_wrong_bit_anywhere_is_seen(place, monkeypatch, tmp_path):
    path = recorded("f_sbn_disconnect", tmp_path / "a.mcap")
    octets = bytearray(path.read_bytes())
    octets[int(place * octets.index(COUNTS_METADATA_NAME.encode()))] ^= 4
    path.write_bytes(octets)
    assert not compared([path], monkeypatch)


@pytest.mark.each(2)
@pytest.mark.long("*no number*", "*datagrams*: 3}*")
@pytest.mark.parametrize(
    "values",
    [
        {"version": "0.0.1"},
        {"crc": "1"},
        {"covers": "12"},
        {"covers": "no number"},
        {"counts": "{"},
        {"counts": "[]"},
        {"counts": '{"datagrams": 3}'},
        {"counts": json.dumps({key: [[1]] for key in (*TOTALS, "accounts")})},
        {"counts": json.dumps({**dict.fromkeys(TOTALS, 1), "accounts": [[1]]})},
    ],
    ids=str,
)
def test_counts_that_do_not_fit_are_not_used(values, monkeypatch, tmp_path):
    add = writer.McapFile.add_metadata

    def changed(self, name, told):
        add(self, name, {**told, **values} if name == COUNTS_METADATA_NAME else told)

    monkeypatch.setattr(writer.McapFile, "add_metadata", changed)
    path = recorded("b_arm_single", tmp_path / "a.mcap")
    assert not compared([path], monkeypatch)


def test_what_was_captured_twice_is_read(monkeypatch, tmp_path):
    """Of equal datagrams within 20 ms one may be left out; which, reading tells."""
    octets = FILES["a_rover"].read_bytes()
    head, size = octets[:24], 16 + int.from_bytes(octets[32:36], "little")
    twice = tmp_path / "twice.pcap"
    twice.write_bytes(head + octets[24 : 24 + size] + octets[24:])
    path = tmp_path / "a.mcap"
    record(open_files([twice]), SETTINGS.workbench(), Target(path))
    assert not compared([path], monkeypatch)


def test_a_later_metadata_record_of_the_name_is_no_answer(monkeypatch, tmp_path):
    path = recorded("a_rover", tmp_path / "a.mcap")
    octets = path.read_bytes()
    end = octets.rindex(bytes([Opcode.DATA_END]) + (4).to_bytes(8, "little"))
    more = record_bytes(Metadata(COUNTS_METADATA_NAME, {"version": "0.2.0", "counts": "{}"}))
    path.write_bytes(octets[:end] + more + octets[end:])
    assert not compared([path], monkeypatch)


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere"),
]
SAMPLES = sorted((ROOT / "samples/captures").glob("*.pcap"))


@pytest.fixture(autouse=True)
def any_file(monkeypatch):
    """Small files are read ahead too, in many windows."""
    monkeypatch.setattr("edoras_tools.io.processors._LARGE", 1)
    for name in ("FIRST", "_SECOND_WINDOW", "SLICE"):
        monkeypatch.setattr(stream, name, 8 << 10)


def looked_at(path, jobs, **how):
    source = open_files([path])
    return inspect(source, Settings().workbench(source.info), jobs=jobs, **how)


def same(one, other):
    """Compare two batches, or the columns of two, byte for byte."""
    for name in type(one).__struct_fields__:
        here, there = getattr(one, name), getattr(other, name)
        assert np.array_equal(here, there), name
        assert getattr(here, "dtype", None) == getattr(there, "dtype", None), name
    return True


@pytest.mark.quick("a_rover")
@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_info_is_the_same_with_any_number_of_processes(path):
    found = [looked_at(path, jobs).summary() for jobs in ((1, 2, 3) if LONG else (1, 3))]
    assert all(item == found[0] for item in found)
    assert found[0]["datagrams"] > 500


@settings(max_examples=examples(10, part=3, least=3))
@given(
    window=st.integers(6_000, 200_000),
    batches=st.integers(1, 6),
    room=st.sampled_from([1 << 10, 40 << 10, 9 << 20]),
    slot=st.sampled_from([1 << 10, 100 << 10, 32 << 20]),
)
def test_batches_are_the_same_however_they_are_cut(window, batches, room, slot):
    path = ROOT / "samples/captures/a_rover.pcap"
    with (
        patch.multiple(stream, FIRST=window, _SECOND_WINDOW=window, SLICE=window),
        patch.multiple(module, _BATCHES=batches),
        patch.multiple(processes, ROOM_BYTES=room, SLOT_BYTES=slot),
    ):
        here, there = open_files([path]), open_files([path])
        decoder = Settings().workbench(here.info).columns
        ahead = Ahead(there, Settings().workbench(there.info).columns)
        with closing(here), closing(ahead):
            for one, other in zip_longest(here.batches(), ahead.batches()):
                assert isinstance(other, PacketBatch)
                columns = ahead.decoded(other, ahead._decoder.decode)
                assert isinstance(columns, Columns)
                assert same(decoder.decode(one), columns)
                assert same(one, other)
                assert here.statistics.frames == ahead.statistics.frames
    assert here.statistics == ahead.statistics
    assert ahead.statistics.datagrams == 1827


CAPTURE_FILES = sorted(CAPTURES.glob("*.pcap*"))
READERS = ("all", "none", "every third")
# In `make test` each file has one kind of reader, and each kind reads two files.
IN_TURNS = list(zip(CAPTURE_FILES, cycle(READERS)))


@pytest.mark.quick("f_sbn*")
@pytest.mark.parametrize(
    ("path", "here"),
    long_but(IN_TURNS, list(product(CAPTURE_FILES, READERS))),
    ids=lambda item: item if isinstance(item, str) else item.name,
)
def test_whoever_decodes_a_batch_reads_the_same(path, here, monkeypatch):
    count = iter(range(1 << 20))
    awaited = {
        "all": lambda _: True,
        "none": lambda _: False,
        "every third": lambda _: next(count) % 3 == 0,
    }
    monkeypatch.setattr(processes.Desk, "awaited", property(awaited[here]))
    one, two = (open_files([path]) for _ in range(2))
    decoder, other = (Settings().workbench(one.info).columns for _ in range(2))
    ahead = Ahead(two, other)
    begun = batches = 0
    with closing(one), closing(ahead):
        for expected, batch in zip_longest(one.batches(), ahead.batches()):
            begun += isinstance(ahead._decoded[1], Begun)
            batches += 1
            assert same(decoder.decode(expected), ahead.decoded(batch, other.decode))
    assert begun == {"all": batches, "none": 0, "every third": -(-batches // 3)}[here]
    assert decoder.context.notes == other.context.notes
    assert decoder.context.described == other.context.described
    if here == "all" and batches:
        assert decoder.context.detected == other.context.detected


@pytest.mark.long
def test_what_is_said_of_the_whole_so_far_is_said_once(tmp_path):
    """Conversations of another build begin late, one after the other: a note names all of them."""

    def conversation(number):
        begin_ns = plain[-1].time_ns + number * 100 * SECOND
        return [
            replace(item.at(begin_ns - extended[0].time_ns), source=(item.source[0], item.source[1] + number))
            for item in extended[:200]
        ]

    plain = datagrams(CAPTURES / "a_rover.pcap")
    extended = datagrams(ROOT / "tests/captures/p6b_extended_header.pcap.zst")
    path = write(tmp_path / "builds.pcap", [*plain, *conversation(1), *conversation(2)])
    one, two = (looked_at(path, jobs).summary() for jobs in (1, 2))
    assert one == two
    (note,) = one["warnings"]
    assert "44819 > 127.0.0.1:1235, 127.0.0.1:44820 > 127.0.0.1:1235 and 1 more: read with" in note
    source = open_files([path])
    decoder = Settings().workbench(source.info).columns
    ahead = Ahead(source, decoder)
    with closing(ahead):
        for batch in ahead.batches():
            ahead.decoded(batch, decoder.decode)
    assert "headers" not in decoder.context.described


def test_a_file_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "cut.pcap"
    path.write_bytes((ROOT / "samples/captures/a_rover.pcap").read_bytes()[:100_000])
    one, two = (looked_at(path, jobs) for jobs in (1, 2))
    assert str(one.failure) == str(two.failure)
    assert "ends inside record" in str(two.failure)
    assert one.summary() == two.summary()


def test_what_is_not_wanted_is_not_waited_for():
    before = children()
    found = [
        looked_at(CAPTURES / "a_rover.pcap", jobs, limits=Limits(count=300)).summary() for jobs in (1, 2)
    ]
    assert found[0] == found[1]
    assert found[0]["datagrams"] == 300
    assert children() <= before


def test_what_selects_is_asked_in_one_process(monkeypatch):
    monkeypatch.setattr("edoras_tools.io.processes.fork", None)
    report = looked_at(CAPTURES / "a_rover.pcap", 2, selection=Selection(where="link == to"))
    assert 0 < report.ledger.datagrams < 1827


def test_one_that_is_killed_is_told_and_what_came_before_is_counted(monkeypatch):
    here, given = os.getpid(), []
    decode = module._Reader._decode

    def killed(self, batch):
        given.append(batch)
        if len(given) > 3 and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return decode(self, batch)

    monkeypatch.setattr(module._Reader, "_decode", killed)
    report = looked_at(CAPTURES / "a_rover.pcap", 2)
    assert isinstance(report.failure, CaptureError)
    assert "a_rover.pcap: the process that read it was killed, perhaps" in str(report.failure)
    assert 0 < report.ledger.datagrams < 1827


@pytest.mark.long
def test_where_no_process_can_be_forked_it_is_read_here(monkeypatch):
    def none(*_):
        raise BlockingIOError("Resource temporarily unavailable")

    expected = looked_at(CAPTURES / "a_rover.pcap", 1).summary()
    monkeypatch.setattr("os.fork", none)
    assert looked_at(CAPTURES / "a_rover.pcap", 2).summary() == expected
