"""Inputs by topic, whose batches several processes make tables of: every table is as from one."""

import os
import signal
import sys
import threading
from pathlib import Path

import pytest
from effort import every
from places import CAPTURES, MISSIONS, SAMPLE_MISSIONS
from rtps import CAPTURES as DDS

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats import capture_file
from edoras_tools.io.formats.columns import TableFile
from edoras_tools.io.processes import Workers
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.export import run
from edoras_tools.pipelines.export.reading import TableForm
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.export.sources import CaptureTopics, open_topics
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere"),
]
ROVER = CAPTURES / "a_rover.pcap"


@pytest.fixture(autouse=True)
def submitted(monkeypatch):
    """Small files are shared too, in many windows; the batches that other processes got."""
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 1)
    for name in ("FIRST", "_SECOND_WINDOW", "SLICE"):
        monkeypatch.setattr(capture_file, name, 16 << 10)
    given, submit = [], Workers.submit
    monkeypatch.setattr(Workers, "submit", lambda self, *values: given.append(1) or submit(self, *values))
    return given


def settings(name):
    return Settings(tuple(MISSIONS / f"{item}.yaml" for item in SAMPLE_MISSIONS[name]))


def input_of(name):
    """A sample with its missions, or a capture without."""
    return (name, Settings()) if isinstance(name, Path) else (CAPTURES / f"{name}.pcap", settings(name))


def exported(folder, jobs, path, config, layout="csv", scope=None, form=TableForm()):  # noqa: B008  frozen
    """The files of an export, and what its report says."""
    source = open_topics([path], config, scope)
    target = ExportTarget.of(folder / str(jobs), name=layout, folder=True)
    report = export(source, target, form=form, jobs=jobs).summary()
    files = [(item["topic"], item["rows"], item.pop("path")) for item in report["files"]]
    return report, [(topic, rows, Path(path).read_bytes()) for topic, rows, path in files]


CASES = {
    "Parquet": ("a_rover", "parquet", {}),
    "Arrow": ("f_sbn_disconnect", "arrow", {}),
    "CSV": ("f_sbn_disconnect", "csv", {}),
    "JSON Lines": ("a_rover", "jsonl", {}),
    "malformed": ("e_ci_errors", "csv", {}),
    "selected": (
        "a_rover",
        "csv",
        {"scope": Scope(Selection(where="link == to"), Period(10**9, 4 * 10**10))},
    ),
    "exploded": ("a_rover", "parquet", {"form": TableForm(("header", "pose"), explode=True)}),
    "only the content names them": (next(path for path in DDS if "sender" in path.name), "csv", {}),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_tables_are_the_same_with_any_number_of_processes(case, tmp_path, submitted):
    name, layout, how = case
    one, *others = (exported(tmp_path, jobs, *input_of(name), layout, **how) for jobs in every(2, (1, 2, 3)))
    assert all(other == one for other in others)
    assert sum(rows for _, rows, _ in one[1]) > 60
    assert len(submitted) > 2


@pytest.mark.long
@pytest.mark.parametrize("layout", ["csv", "jsonl", "parquet", "arrow"])
def test_so_they_are_if_everything_is_written_late(layout, tmp_path, submitted, monkeypatch):
    one, late = exported(tmp_path, 1, ROVER, settings("a_rover"), layout), []
    wait = run._Writing.wait

    def waited(self):
        while late:
            work, given = late.pop(0)
            work(*given)
        wait(self)

    monkeypatch.setattr(run._Writing, "do", lambda _, work, *given: late.append((work, given)))
    monkeypatch.setattr(run._Writing, "wait", waited)
    assert exported(tmp_path, 2, ROVER, settings("a_rover"), layout) == one
    assert len(submitted) > 2


@pytest.mark.long
def test_so_are_those_of_a_recording_of_topics(tmp_path, submitted):
    source = open_files([ROVER])
    record(source, settings("a_rover").workbench(source.info), Target(tmp_path / "bag", rosbag2=True))
    one, *others = (exported(tmp_path, jobs, tmp_path / "bag", Settings()) for jobs in (1, 2, 3))
    assert all(other == one for other in others)
    assert {topic: rows for topic, rows, _ in one[1]}["/cmd_vel"] == 600
    assert submitted


def test_a_process_that_was_killed_leaves_nothing(tmp_path, monkeypatch):
    start = Workers.start

    def started(self):
        start(self)
        os.kill(self.processes[0], signal.SIGKILL)

    monkeypatch.setattr(Workers, "start", started)
    with pytest.raises(CaptureError, match=r"a process that made its tables was killed.*--jobs 1"):
        exported(tmp_path, 2, ROVER, settings("a_rover"))
    assert not list(tmp_path.iterdir())


@pytest.mark.quick("write-1-2")
@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(
    ("what", "which"), [("write", 1), ("write", 40), ("complete", 1), ("complete", 2), ("complete", 9)]
)
def test_a_table_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch, jobs, what, which):
    calls, real = [], getattr(TableFile, what)

    def fails(self, *given):
        calls.append(threading.current_thread())
        if len(calls) == which:
            raise CaptureError(f"{self.path}: cannot be written: no")
        real(self, *given)

    monkeypatch.setattr(TableFile, what, fails)
    with pytest.raises(CaptureError, match=r"cannot be written: no$"):
        exported(tmp_path, jobs, ROVER, settings("a_rover"))
    assert not list(tmp_path.iterdir())
    assert what == "complete" or (threading.main_thread() in calls) == (jobs == 1)


def test_what_is_read_no_more_is_written_no_more(tmp_path, monkeypatch):
    real = CaptureTopics.pieces

    def interrupted(self, *given):
        for number, item in enumerate(real(self, *given)):
            if number == 20:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(CaptureTopics, "pieces", interrupted)
    with pytest.raises(KeyboardInterrupt):
        exported(tmp_path, 2, ROVER, settings("a_rover"))
    assert not list(tmp_path.iterdir())
