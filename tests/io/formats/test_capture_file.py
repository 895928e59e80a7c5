"""Recordings in parts: every part is complete, holds no more than it may, and together they are the whole."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from places import ROOT

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.formats.open import open_file
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.capture.record import Target, check_output, open_sink
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND

CAPTURE = ROOT / "samples/captures/a_rover.pcap"
SUFFIXES = [".pcap", ".pcapng", ".mcap"]


@pytest.fixture(scope="module")
def batch():
    with closing(open_file(CAPTURE)) as source:
        (batch,) = source.batches()
    return batch


@pytest.fixture
def written(batch, tmp_path):
    """A function: the parts that are there in the end, and the sink."""

    def run(suffix, step=10_000, **options):
        bench = Settings().workbench()
        with closing(open_file(CAPTURE)) as source:
            sink = open_sink(Target(tmp_path / f"x{suffix}", **options), source, bench)
        for start in range(0, len(batch), step):
            piece = batch.take(slice(start, min(start + step, len(batch))))
            sink.write(piece, bench.columns.decode(piece))
        sink.close(SourceStatistics())
        assert sorted(tmp_path.iterdir()) == sorted(sink.paths)
        return sink.paths, sink

    return run


def read(path):
    with closing(open_file(path)) as source:
        return [frame for item in source.batches() for frame in frames(item)]


def frames(batch):
    ends = batch.frame_offset + batch.frame_length
    return [
        (time, bytes(batch.data[start:end]))
        for time, start, end in zip(
            batch.time_ns.tolist(), batch.frame_offset.tolist(), ends.tolist(), strict=True
        )
    ]


@pytest.mark.each(3)
@pytest.mark.quick("*-97")
@pytest.mark.parametrize("step", [10_000, 97])
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "options",
    [{"split_count": 300}, {"split_ns": 9 * SECOND}, {"split_bytes": 60_000}, {"split_count": 5000}],
)
def test_parts_are_the_whole(suffix, options, step, written, batch):
    paths, _ = written(suffix, step, **options)
    assert [path.name for path in paths] == [f"x_{number}{suffix}" for number in range(len(paths))]
    parts = [read(path) for path in paths]
    assert [frame for part in parts for frame in part] == frames(batch)
    if options.get("split_count"):
        most = options["split_count"]
        assert [len(part) for part in parts] == [
            min(most, len(batch) - start) for start in range(0, len(batch), most)
        ]
    if options.get("split_ns"):
        assert all(part[-1][0] - part[0][0] < options["split_ns"] for part in parts)
    if options.get("split_bytes"):
        assert len(paths) > 2
        if suffix != ".mcap":
            assert all(50_000 < path.stat().st_size <= 60_000 for path in paths[:-1])


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng"])
def test_a_frame_that_is_larger_than_a_part_is_alone_in_it(suffix, written, batch):
    paths, _ = written(suffix, split_bytes=1)
    assert len(paths) == len(batch)
    assert read(paths[-1]) == frames(batch)[-1:]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_only_the_newest_are_kept(suffix, written, batch):
    paths, sink = written(suffix, split_count=200, keep_files=3)
    last = (len(batch) - 1) // 200
    assert [path.name for path in paths] == [f"x_{number}{suffix}" for number in (last - 2, last - 1, last)]
    assert (sink.keep.deleted, sink.keep.datagrams) == (last - 2, 200 * (last - 2))
    assert [frame for path in paths for frame in read(path)] == frames(batch)[200 * (last - 2) :]


@pytest.mark.quick(".pcap")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_all_together_are_no_larger_than_is_to_be_kept(suffix, written):
    paths, sink = written(suffix, 20, split_count=100, keep_bytes=100_000)
    ends = 10_000 if suffix == ".mcap" else 0  # the summary, which comes last
    assert sum(path.stat().st_size for path in paths) <= 100_000 + ends
    assert len(paths) > 2
    assert sink.keep.deleted > 2


def test_a_bag_lists_only_what_is_kept(batch, tmp_path):
    bench = Settings().workbench()
    with closing(open_file(CAPTURE)) as source:
        target = Target(tmp_path / "bag", rosbag2=True, split_count=500, keep_files=2)
        sink = open_sink(target, source, bench)
    sink.write(batch, bench.columns.decode(batch))
    sink.close(SourceStatistics())
    assert {path.name for path in (tmp_path / "bag").iterdir()} == {
        "bag_2.mcap",
        "bag_3.mcap",
        "metadata.yaml",
    }
    text = (tmp_path / "bag/metadata.yaml").read_text()
    assert "bag_3.mcap" in text
    assert "bag_1.mcap" not in text


def test_what_somebody_moved_away_is_theirs(batch, tmp_path):
    """It is neither deleted nor told as lost: it would have been deleted here."""
    bench = Settings().workbench()
    with closing(open_file(CAPTURE)) as source:
        target = Target(tmp_path / "x.pcap", split_count=100, keep_files=2)
        sink = open_sink(target, source, bench)
    pieces = [batch.take(np.arange(start, start + 100)) for start in range(0, 500, 100)]
    for piece in pieces[:2]:
        sink.write(piece, bench.columns.decode(piece))
    first = (tmp_path / "x_0.pcap").rename(tmp_path / "mine.pcap")
    for piece in pieces[2:]:
        sink.write(piece, bench.columns.decode(piece))
    sink.close(SourceStatistics())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.pcap", "x_3.pcap", "x_4.pcap"]
    assert len(read(first)) == 100
    assert (sink.losses, sink.keep.deleted) == ([], 2)


def test_an_older_part_is_never_replaced(tmp_path):
    (tmp_path / "x_1.pcap").write_bytes(b"older")
    with pytest.raises(ConfigError, match=r"x_1\.pcap exists"):
        check_output(Target(tmp_path / "x.pcap", split_count=5), [])


def test_a_folder_that_takes_no_second_file(batch, tmp_path):
    """The first part stays as it is."""
    bench = Settings().workbench()
    (tmp_path / "x_1.pcap").mkdir()
    with closing(open_file(CAPTURE)) as source:
        sink = open_sink(Target(tmp_path / "x.pcap", split_count=100), source, bench)
    with pytest.raises(CaptureError, match=r"x_1\.pcap: cannot be created"):
        sink.write(batch, bench.columns.decode(batch))
    sink.abandon()
    assert read(tmp_path / "x_0.pcap") == frames(batch)[:100]
