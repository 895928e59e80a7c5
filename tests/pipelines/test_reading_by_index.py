"""A time of a recording is read by its index: what is shown is what reading all of it shows."""

import pytest
from effort import long_but
from places import CAPTURES, MISSIONS, SAMPLES

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap import chunks, reader
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import Scope, examine
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.pipelines.selection import Period
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

SETTINGS = Settings((MISSIONS / "rover_ground.yaml",))
FILES = {
    "rover": CAPTURES / "a_rover.pcap",
    "arm": CAPTURES / "b_arm_single.pcap",
    "sbn": CAPTURES / "f_sbn_disconnect.pcap",
    "dds": SAMPLES / "rtps/cyclone_sender.pcap.gz",
}
TAKES_NO_NARROWING = lambda self, period: None  # noqa: E731


@pytest.fixture(scope="module", autouse=True)
def small():
    """Chunks and batches of a few KiB, and a lead of half a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "CHUNK_BYTES", 4 << 10)
        patch.setattr(reader, "_BATCH_BYTES", 8 << 10)
        patch.setattr(reader, "_LEAD_NS", SECOND // 2)
        yield


@pytest.fixture(scope="module")
def recordings(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("by_index")
    for name, path in FILES.items():
        record(open_files([path]), SETTINGS.workbench(), Target(folder / f"{name}.mcap"))
    return {name: folder / f"{name}.mcap" for name in FILES}


def shown(path, period):
    """What the read loop, info and the doctor make of a time; and how many datagrams were passed over."""
    source, rows = open_files([path]), []
    with reading(source, SETTINGS.workbench(), limits=Limits(period=period)) as loop:
        for some in loop:
            batch, columns = some.alone()
            rows += zip(
                batch.number.tolist(), columns.msg_id.tolist(), columns.findings.tolist(), strict=True
            )
    report = inspect(open_files([path]), SETTINGS.workbench(), limits=Limits(period=period)).summary()
    found = examine(open_files([path]), SETTINGS.workbench(), scope=Scope(period=period))
    return (rows, report, found.summary(), loop.begin_ns, loop.last_ns), source.statistics


TIMES = [
    *(("rover", *time) for time in ((1.5, 0.7), (6, 3), (12.5, 8), (40, 500))),
    *(("arm", *time) for time in ((9.25, 0.25), (20, 12))),
    *(("sbn", *time) for time in ((11, 2), (20, 4))),
]


@pytest.mark.each(3)
@pytest.mark.parametrize(("name", "start", "length"), long_but(TIMES[1::3], TIMES))
def test_a_time_is_shown_as_if_all_was_read(recordings, name, start, length, monkeypatch):
    period = Period(int(start * SECOND), int((start + length) * SECOND))
    by_index, counts = shown(recordings[name], period)
    monkeypatch.setattr(reader.McapSource, "narrow", lambda *_: None)
    whole, all_counts = shown(recordings[name], period)
    assert by_index == whole
    assert counts.datagrams + counts.passed_over == all_counts.datagrams
    assert counts.passed_over > all_counts.passed_over == 0


def test_what_is_beyond_the_end_is_said_with_the_last_time(recordings, monkeypatch):
    def refusal():
        with pytest.raises(CaptureError) as caught:
            shown(recordings["rover"], Period(900 * SECOND))
        return str(caught.value)

    by_index = refusal()
    monkeypatch.setattr(reader.McapSource, "narrow", lambda *_: None)
    assert by_index == refusal()
    assert "its times go from 0 to 65.270 s" in by_index


@pytest.mark.each(2)
@pytest.mark.parametrize("name", ["dds", "older"])
def test_what_needs_the_beginning_is_read_whole(name, recordings, monkeypatch):
    """DDS names its topics there; a recording of an earlier version does not say whose traffic it has."""
    if name == "older":
        monkeypatch.setattr(reader, "_labels", lambda _: None)
    path = recordings.get(name, recordings["rover"])
    assert shown(path, Period(2 * SECOND, 3 * SECOND))[1].passed_over == 0


def read(path):
    """Read a time of a recording; return the counts, and its failure."""
    source = open_files([path])
    with reading(
        source, SETTINGS.workbench(), limits=Limits(period=Period(6 * SECOND, 9 * SECOND)), keeps_failure=True
    ) as loop:
        assert sum(map(len, loop)) > 50
    return source.statistics, loop.failure


def test_damage_where_nothing_was_asked_for_is_told(recordings, tmp_path):
    octets = bytearray(recordings["rover"].read_bytes())
    octets[len(octets) * 7 // 10] ^= 4
    path = tmp_path / "a.mcap"
    path.write_bytes(octets)
    counts, failure = read(path)
    assert counts.passed_over
    assert failure is None
    (line,) = counts.warnings
    assert line.startswith(f"{path}: is damaged, perhaps only where nothing was asked for")
    assert not read(recordings["rover"])[0].warnings


def test_a_damaged_summary_is_not_relied_on(recordings, tmp_path):
    octets = bytearray(recordings["rover"].read_bytes())
    index = octets.rindex(b"/edoras/datagrams")
    for place in range(index, len(octets) - 600, 50):  # times and places of chunks among them
        octets[place] ^= 0x80
    path = tmp_path / "a.mcap"
    path.write_bytes(octets)
    counts, _ = read(path)
    assert (counts.frames, counts.passed_over) == (1827, 0)
