"""A command for each complete file: the recording is whole whatever it does."""

from contextlib import closing
from functools import partial

import pytest
from places import CAPTURES, MISSIONS
from waiting import until

from edoras_tools.addons.operations import after_split
from edoras_tools.addons.operations.after_split import AfterSplit
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings, open_files

ROVER = CAPTURES / "a_rover.pcap"
SETTINGS = Settings([MISSIONS / "rover_ground.yaml"])
TOTAL = 1827


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(after_split, "PAUSES_S", (0.01, 0.02))


def recorded(folder, after, name="a.pcap", **how):
    """Record in parts; return them."""
    source = open_files([ROVER])
    target = Target(folder / name, split_count=700, on_complete=after.add, **how)
    return record(source, SETTINGS.workbench(source.info), target).outputs


def total(paths):
    count = 0
    for path in paths:
        with closing(open_file(path)) as source:
            count += sum(map(len, source.batches()))
    return count


@pytest.mark.parametrize("name", ["a.pcap", "a.mcap"])
def test_each_complete_file_is_handed_over_once_and_whole(tmp_path, name):
    told = []
    after = AfterSplit(f"cp {{}} {tmp_path}/copies/", told.append)
    (tmp_path / "copies").mkdir()
    paths = recorded(tmp_path, after, name)
    after.end()
    assert [path.stem for path in paths] == ["a_0", "a_1", "a_2"]
    assert total(tmp_path / "copies" / path.name for path in paths) == TOTAL
    assert told == []


def test_a_command_that_fails_is_told_tried_again_and_costs_nothing(tmp_path):
    told = []
    script = tmp_path / "fails.sh"
    script.write_text(f'echo "$1" >> {tmp_path}/calls; echo "no such host" >&2; exit 7\n')
    after = AfterSplit(f"sh {script} {{}}", told.append)
    paths = recorded(tmp_path, after)
    with pytest.raises(CaptureError, match=r"failed for 3 files, which are there: .*a_0\.pcap"):
        after.end()
    assert total(paths) == TOTAL
    assert {*(tmp_path / "calls").read_text().split()} == {*map(str, paths)}
    assert all("sh ended with exit code 7: no such host" in line for line in told)


def test_what_fails_first_and_then_does_not_is_no_failure(tmp_path):
    told, path = [], tmp_path / "a.pcap"
    path.touch()
    after = AfterSplit(
        f"sh -c 'rm {tmp_path}/once || {{ touch {tmp_path}/once; exit 1; }}' {{}}", told.append
    )
    after.add(path)
    until(lambda: told, lambda: "the first failure")
    after.end()
    assert len(told) == 1


def test_a_slow_command_holds_up_nothing(tmp_path):
    """It ends only once the whole recording is there."""
    script = tmp_path / "slow.sh"
    script.write_text(f'while [ ! -e {tmp_path}/go ]; do sleep 0.02; done; echo "$1" >> {tmp_path}/calls\n')
    after = AfterSplit(f"sh {script} {{}}", pytest.fail)
    paths = recorded(tmp_path, after)
    assert total(paths) == TOTAL
    assert not (tmp_path / "calls").exists()
    (tmp_path / "go").touch()
    after.end()
    assert (tmp_path / "calls").read_text().split() == [*map(str, paths)]


def test_one_that_does_not_end_and_one_that_is_not_there(tmp_path):
    path = tmp_path / "a.pcap"
    path.touch()
    for command, why in (
        ("sh -c 'sleep 60' {}", "did not end within 0.05 s"),
        ("no-such-program {}", "cannot be run"),
    ):
        told = []
        after = AfterSplit(command, told.append, longest_s=0.05)
        after.add(path)
        after.add(tmp_path / "moved away")
        with pytest.raises(CaptureError, match="failed for 1 file"):
            after.end()
        assert why in told[0]


@pytest.mark.parametrize("command", ["gzip", "gzip '{}"])
def test_a_command_without_a_file_is_refused(command):
    with pytest.raises(ConfigError, match="--after-split"):
        AfterSplit(command, partial(pytest.fail))


def test_it_is_for_parts(call, captures):
    done = call("record", captures("a_rover"), "-o", "a.mcap", "--after-split", "gzip {}")
    assert done.err[-1].endswith("--after-split is for a recording in parts: split too, e.g. --split 10m")
