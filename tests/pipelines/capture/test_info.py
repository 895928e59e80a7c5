"""What the recorder counted is what reading the recording counts; where that is not sure, it is read."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from effort import long_but
from mcap.opcode import Opcode
from mcap.records import Metadata
from places import CAPTURES, MISSIONS, SAMPLES

from edoras_tools.io.formats.mcap import chunks, reader, writer
from edoras_tools.io.formats.mcap.file import record_bytes
from edoras_tools.io.formats.recover import repair
from edoras_tools.io.topics.messages import COUNTS_METADATA_NAME
from edoras_tools.pipelines.capture.info import inspect
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
