"""A recording goes on beside a file that somebody takes away."""

import os
import shutil
import threading
from contextlib import closing
from pathlib import Path

import pytest
from places import ROOT

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.watched import OutputLoss, WatchedSink
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.capture.record import Target, open_sink
from edoras_tools.pipelines.workbench import Settings

CAPTURE = ROOT / "samples/captures/a_rover.pcap"
KINDS = ["x.mcap", "x.pcap", "x.pcapng", "bag"]


@pytest.fixture
def batches():
    with closing(open_file(CAPTURE)) as source:
        (batch,) = source.batches()
    return [batch.take(slice(start, start + 100)) for start in range(0, 400, 100)]


class Recording:
    """Written step by step, its clock moved by hand."""

    def __init__(self, path, **options):
        self.now, self.told = 0.0, []
        self._bench = Settings().workbench()
        self._source = open_file(CAPTURE)
        target = Target(path, rosbag2=not path.suffix, on_warning=self.told.append, **options)
        with closing(self._source) as kept:
            self.sink = open_sink(target, kept, self._bench)
        self.sink._clock, self.sink._looked, self.sink._synced = lambda: self.now, 0.0, 0.0

    def write(self, batch):
        self.sink.write(batch, self._bench.columns.decode(batch))
        self.sink.flush()

    def later(self):
        """A second passes, in which nothing comes."""
        self.now += 1.0
        self.sink.flush()

    def end(self):
        self.sink.close(self._source.statistics)


def file_of(path):
    return path / f"{path.name}_0.mcap" if not path.suffix else path


def count(path):
    source = open_file(file_of(path))
    try:
        return sum(len(batch) for batch in source.batches())
    finally:
        source.close()


def delete(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def replace(path):
    (path.parent / "other").write_bytes(b"other")
    (path.parent / "other").rename(file_of(path))


def truncate(path):
    file_of(path).write_bytes(b"")


@pytest.mark.quick("delete*.mcap", "replace*.pcap")
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    ("how", "fate"),
    [(delete, "was deleted"), (replace, "was replaced by another file"), (truncate, "was truncated")],
)
def test_what_is_taken_away(name, how, fate, batches, tmp_path):
    path = tmp_path / name
    beside = tmp_path / name.replace("x", "x_1").replace("bag", "bag_1")
    recording = Recording(path)
    recording.write(batches[0])
    how(path)
    recording.write(batches[1])  # nobody looks within a second
    assert not recording.told
    recording.later()
    line = f"{file_of(path)} {fate} while it was written: 200 datagrams are lost"
    assert recording.told == [f"{line}; continuing in {beside}"]
    recording.write(batches[2])
    recording.end()
    assert recording.sink.paths == [beside]
    assert recording.sink.losses == [OutputLoss(file_of(path), fate, 200, recoverable=False)]
    assert count(beside) == 100
    if how is replace:
        assert file_of(path).read_bytes() == b"other"


@pytest.mark.each(2)
@pytest.mark.parametrize("name", KINDS)
def test_what_is_moved_is_whole_where_it_is(name, batches, tmp_path):
    path, moved = tmp_path / name, tmp_path / f"moved_{name}"
    recording = Recording(path)
    recording.write(batches[0])
    path.rename(moved)
    recording.write(batches[1])
    recording.later()
    recording.write(batches[2])
    recording.end()
    (loss,) = recording.sink.losses
    place = moved / file_of(path).name if not path.suffix else moved
    assert (loss.fate, loss.datagrams, loss.recoverable) == (f"was moved to {place}", 200, True)
    assert count(recording.sink.paths[0]) == 100
    source = open_file(place)
    assert sum(len(batch) for batch in source.batches()) == 200
    source.close()
    if not path.suffix:
        assert (moved / "metadata.yaml").exists()


@pytest.mark.parametrize("name", ["x.mcap", "x.pcap", "x.pcapng"])
def test_what_is_moved_out_of_sight_is_whole_there(name, batches, tmp_path):
    """As when a service may not see the folder: the system does not say where it is, only that it is."""
    path, moved = tmp_path / name, tmp_path / f"moved_{name}"
    recording = Recording(path)
    recording.write(batches[0])
    moved.hardlink_to(path)
    path.unlink()
    recording.later()
    recording.end()
    (loss,) = recording.sink.losses
    fate = "was moved to where this program cannot see it"
    assert (loss.fate, loss.datagrams, loss.recoverable) == (fate, 100, True)
    assert count(moved) == 100


def test_the_part_that_follows_is_named(batches, tmp_path):
    recording = Recording(tmp_path / "x.mcap", split_ns=10**12)
    recording.write(batches[0])
    (tmp_path / "x_0.mcap").unlink()
    recording.later()
    assert recording.told[0].endswith(f"; continuing in {tmp_path}/x_1_0.mcap")
    recording.write(batches[1])
    recording.end()
    assert count(tmp_path / "x_1_0.mcap") == 100


@pytest.mark.parametrize("name", KINDS)
def test_what_is_taken_away_at_the_end(name, batches, tmp_path):
    recording = Recording(tmp_path / name)
    recording.write(batches[0])
    delete(tmp_path / name)
    recording.end()
    assert recording.sink.paths == []
    assert [(item.fate, item.datagrams) for item in recording.sink.losses] == [("was deleted", 100)]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.quick("x.mcap")
@pytest.mark.parametrize("name", KINDS)
def test_again_and_again(name, batches, tmp_path):
    recording = Recording(tmp_path / name)
    for batch in batches:
        recording.write(batch)
        delete(recording.sink.paths[-1])
        recording.later()
    recording.end()
    assert [item.datagrams for item in recording.sink.losses] == [100] * len(batches)
    assert count(recording.sink.paths[-1]) == 0 if name != "bag" else True


@pytest.mark.each(3)
@pytest.mark.parametrize("name", ["x.mcap", "bag"])
@pytest.mark.parametrize(
    ("how", "fate"),
    [
        (Path.unlink, "was deleted or moved"),
        (lambda path: os.truncate(path, 100), "was truncated"),
        (lambda path: path.with_name("other").rename(path), "was replaced by another file"),
    ],
)
def test_a_finished_file_that_is_taken_away_is_told_at_the_end(name, how, fate, batches, tmp_path):
    recording = Recording(tmp_path / name, split_ns=1)
    for batch in batches:
        recording.write(batch.take(slice(0, 1)))
    first, *others = sorted(tmp_path.rglob("*_[0-9].mcap"))
    assert len(others) == 3
    first.with_name("other").write_bytes(b"other")
    how(first)
    recording.later()
    assert not recording.told
    recording.end()
    assert recording.sink.losses == [OutputLoss(first, fate, 1, recoverable=False, complete=True)]
    assert str(recording.sink.losses[0]) == f"{first} {fate} when it was complete: it held 1 datagram"
    assert recording.sink.paths == (others if name == "x.mcap" else [tmp_path / name])


def test_a_second_recorder_is_refused(batches, tmp_path):
    first = Recording(tmp_path / "x.mcap")
    first.write(batches[0])
    with pytest.raises(CaptureError, match=r"x\.mcap: cannot be created: another program is writing it"):
        Recording(tmp_path / "x.mcap")
    first.end()
    assert count(tmp_path / "x.mcap") == 100


def test_where_no_other_can_be_begun(batches, tmp_path):
    """It fails, and closing it does not fail again."""

    class Begun:
        def __init__(self, path):
            if path.name != "x":
                raise CaptureError("no room")
            self.output, self.paths, self.datagrams, self.complete = self, [path], 7, []
            self.path, self.linked = path, False

        def fate(self):
            return "was deleted"

        def flush(self):
            pass

        def abandon(self):
            pass

    now = [0.0]
    sink = WatchedSink(tmp_path / "x", Begun, print, SourceStatistics(), clock=lambda: now[0])
    now[0] = 2.0
    with pytest.raises(CaptureError, match="no room"):
        sink.flush()
    with pytest.raises(CaptureError, match="closed"):
        sink.write(batches[0], None)
    sink.close(SourceStatistics())
    assert (sink.paths, [item.datagrams for item in sink.losses]) == ([], [7])


@pytest.mark.each(3)
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("sync_ns", [0, 1_000_000_000])
def test_what_is_to_outlast_a_power_cut_is_synced_at_the_interval_and_at_the_end(
    name, sync_ns, tmp_path, batches, monkeypatch
):
    """The file with all that was taken until then, and its folder; nothing where nobody asked for it."""
    synced = []

    def noting(fileno):
        place = Path(f"/proc/self/fd/{fileno}").readlink()
        synced.append((place, place.stat().st_size if place.is_file() else None))

    monkeypatch.setattr(os, "fdatasync", noting)
    path = tmp_path / name
    file = file_of(path)
    recording = Recording(path, sync_ns=sync_ns)
    for batch in batches:
        recording.write(batch)
        assert not synced
    recording.later()
    if sync_ns:
        recording.sink._syncing.result()
    assert synced == ([(file, file.stat().st_size), (file.parent, None)] if sync_ns else [])
    synced.clear()
    recording.end()
    files = {(item, item.stat().st_size) for item in tmp_path.rglob("*") if item.is_file()}
    assert {item for item in synced if item[1] is not None} == (files if sync_ns else set())


def test_syncs_keep_their_interval(tmp_path, batches, monkeypatch):
    """However unevenly data comes: 41 flushes, 230 ms apart."""
    synced = []
    recording = Recording(tmp_path / "x.pcap", sync_ns=1_000_000_000)
    monkeypatch.setattr(recording.sink, "_to_disk", lambda *_: synced.append(recording.now))
    for _ in range(41):
        recording.now += 0.23
        recording.sink.flush()
        if recording.sink._syncing:
            recording.sink._syncing.result()
    recording.end()
    assert len(synced) == 9 + 1


def test_a_disk_that_fails_is_told(tmp_path, batches, monkeypatch):
    def failing(_fileno):
        raise OSError(5, "Input/output error")

    recording = Recording(tmp_path / "x.mcap", sync_ns=1)
    monkeypatch.setattr(os, "fdatasync", failing)
    recording.write(batches[0])
    recording.later()
    with pytest.raises(CaptureError, match=r"x\.mcap: cannot be synced: Input/output error"):
        recording.end()
    assert count(tmp_path / "x.mcap") == 100


def test_a_disk_that_hangs_keeps_nothing_from_the_file(tmp_path, batches, monkeypatch):
    """Killed now, the recorder has lost nothing: only a power cut could take it."""
    hanging = threading.Event()
    monkeypatch.setattr(os, "fdatasync", lambda _: hanging.wait(30))
    path = tmp_path / "x.mcap"
    recording = Recording(path, sync_ns=1_000_000_000)
    sizes = []
    for batch in batches:
        recording.write(batch)
        recording.later()
        sizes.append(path.stat().st_size)
    assert sizes == sorted(set(sizes))
    hanging.set()
    recording.end()
    assert count(path) == 400
