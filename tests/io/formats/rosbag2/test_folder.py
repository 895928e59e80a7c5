"""A rosbag2 directory of ours, beside the single file of the same capture."""

import shutil
from contextlib import closing

import pytest
from places import ROOT

from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.rosbag2.reader import FolderSource
from edoras_tools.model import HostCounters
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings

CAPTURE = ROOT / "samples/captures/a_rover.pcap"


def rows(path):
    source = open_file(path)
    found = [row for batch in source.batches() for row in batch]
    source.close()
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("folder") / "bag"
    record(open_file(CAPTURE), Settings().workbench(), Target(path, rosbag2=True, split_count=500))
    return path


def test_its_parts_are_one_capture(folder):
    assert len([*folder.glob("*.mcap")]) == 4
    assert rows(folder) == rows(CAPTURE)
    with closing(open_file(folder)) as source:
        assert (source.info.name, source.info.kind) == (str(folder), "rosbag2")


def test_without_metadata_it_is_only_a_directory(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "runs")
    (tmp_path / "runs/metadata.yaml").unlink()
    with pytest.raises(CaptureError, match="runs: is a directory; name a capture in it"):
        open_file(tmp_path / "runs")


def test_its_metadata_alone_is_no_recording(folder, tmp_path):
    shutil.copy(folder / "metadata.yaml", tmp_path)
    with pytest.raises(CaptureError, match=r"the files that its metadata\.yaml names are not there"):
        open_file(tmp_path)


def test_a_damaged_part_is_named(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "bag")
    (tmp_path / "bag/bag_2.mcap").write_bytes(b"no recording")
    with pytest.raises(CaptureError, match=r"bag_2\.mcap: "):
        open_file(tmp_path / "bag")


def test_a_database_holds_no_datagrams(tmp_path):
    (tmp_path / "a.db3").write_bytes(b"SQLite format 3\0" + bytes(84))
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [a.db3]}")
    for path in (tmp_path, tmp_path / "a.db3"):
        with pytest.raises(NoDatagramsError, match=r"a\.db3: .*info, sniff, .* read its topics"):
            open_file(path)


def test_the_counters_of_the_host_come_from_all_parts(folder):
    class Part:
        def __init__(self, number):
            self.number = number

        def host(self):
            return [HostCounters(self.number, ())]

    told = FolderSource(folder, [Part(1), Part(2)]).host()
    assert [item.time_ns for item in told] == [1, 2]
