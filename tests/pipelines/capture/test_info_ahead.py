"""A file that another process reads and decodes: all is as with one process."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import closing
from itertools import cycle, product, zip_longest
from unittest.mock import patch

import numpy as np
import pytest
from children import children
from effort import LONG, examples, long_but
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import CAPTURES, ROOT
from rewriting import datagrams, write

from edoras_tools.decode.columns import Begun
from edoras_tools.errors import CaptureError
from edoras_tools.io import processes
from edoras_tools.io.formats import capture_file
from edoras_tools.model import Columns, PacketBatch
from edoras_tools.pipelines.capture import info as module
from edoras_tools.pipelines.capture.info import Ahead, inspect
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere"),
]
SAMPLES = sorted((ROOT / "samples/captures").glob("*.pcap"))


@pytest.fixture(autouse=True)
def any_file(monkeypatch):
    """Small files are read ahead too, in many windows."""
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 1)
    for name in ("FIRST", "_SECOND_WINDOW", "SLICE"):
        monkeypatch.setattr(capture_file, name, 8 << 10)


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
        patch.multiple(capture_file, FIRST=window, _SECOND_WINDOW=window, SLICE=window),
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
