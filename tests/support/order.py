"""Which file of tests runs when: the longest of the last whole run first, so that none is left at the end.

The seconds of each file are kept where pytest keeps what it knows of the last run; ``pytest --cache-clear``
forgets them. Behind a whole run the files are printed that cost the most time of processors, which other work
on the machine changes little: their own, and that of the programs that they started and saw end.

Files whose ``TOGETHER`` is the same run in one process, one after the other: they share what is made once.
"""

from __future__ import annotations

import os
from collections import Counter

import pytest

KEY = "edoras/seconds of files"
SHOWN = 25
FEW_AND_LONG = {
    "addons/archive/test_cli.py": 14,
    "addons/archive/test_update.py": 8,
    "addons/codegen/ground/test_cosmos.py": 5,
    "addons/dds/test_graph.py": 9,
    "addons/lab/demo/test_run.py": 15,
    "addons/lab/proof/test_model.py": 6,
    "addons/mission_draft/test_learn.py": 10,
    "addons/rtps/test_sending.py": 6,
    "addons/test_deletion.py": 6,
    "addons/trace/test_tracer.py": 6,
    "addons/tui/test_viewer.py": 15,
    "addons/tui/test_workbench.py": 15,
    "addons/wireshark/test_program.py": 7,
    "cli/test_dds.py": 7,
    "cli/test_doctor.py": 12,
    "cli/test_listening.py": 6,
    "cli/test_replay.py": 10,
    "cli/test_streams.py": 8,
    "cli/test_two_spacecraft.py": 20,
    "decode/filters/test_agreement.py": 5,
    "decode/test_agreement.py": 5,
    "diagnosis/test_rules.py": 18,
    "diagnosis/test_truth.py": 7,
    "diagnosis/test_variants.py": 10,
    "dissectors/test_agreement.py": 6,
    "links/test_installed.py": 8,
    "middleware/test_ros.py": 15,
    "pipelines/capture/test_info.py": 9,
    "pipelines/test_doctor.py": 6,
    "pipelines/test_ahead.py": 5,
    "pipelines/test_clocks.py": 6,
    "test_budget.py": 9,
    "test_same_bytes.py": 11,
    "test_workers.py": 6,
}
"""Seconds of files with few tests, for a first run: they would come last, and keep one worker busy alone."""


class Order:
    """A plugin: sorts by the seconds of the last whole run, and takes those of this one."""

    def __init__(self, config):
        self._cache = getattr(config, "cache", None)  # none with -p no:cacheprovider
        whole = config.args_source is config.ArgsSource.TESTPATHS
        self._whole = whole and not config.option.keyword and not config.option.markexpr
        self._seconds, self._cpu = Counter(), Counter()
        self._before = 0.0

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        """Sort the files, each a whole; one that never ran is as long as is said here, or has tests."""
        before = self._cache.get(KEY, {}) if self._cache else {}
        many = Counter(map(file_of, (item.nodeid for item in items)))
        files = {file_of(item.nodeid): item for item in items}
        units = {name: together(item) for name, item in files.items()}
        seconds = Counter()
        for name, unit in units.items():
            first = FEW_AND_LONG.get(name.removeprefix("tests/"), many[name] / 20)
            seconds[unit] += before.get(name, first)
        places = {name: (-seconds[unit], unit) for name, unit in units.items()}
        items.sort(key=lambda item: places[file_of(item.nodeid)])

    def pytest_runtest_logstart(self):
        """Begin to count the processors' time."""
        self._before = processor_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self):
        """Say with each part of a test what time of processors it took."""
        report = yield
        now = processor_seconds()
        report.cpu, self._before = now - self._before, now
        return report

    def pytest_runtest_logreport(self, report):
        """Count what a part of a test took."""
        self._seconds[file_of(report.nodeid)] += report.duration
        self._cpu[file_of(report.nodeid)] += getattr(report, "cpu", 0)  # none of a test whose process died

    def pytest_terminal_summary(self, terminalreporter):
        """Print and keep the seconds of the files of a whole run."""
        if self._whole and self._seconds:
            if self._cache:
                self._cache.set(KEY, {name: round(seconds, 2) for name, seconds in self._seconds.items()})
            whole = f"{self._cpu.total():.0f} s of processors in {len(self._cpu)} files"
            terminalreporter.section(f"{whole}; the most, and seconds")
            for name, cpu in self._cpu.most_common(SHOWN):
                terminalreporter.write_line(f"{cpu:6.1f} {self._seconds[name]:6.1f}  {name}")


def together(item):
    """Return what runs in one process with a test: its file, or the name that several files share."""
    return getattr(getattr(item, "module", None), "TOGETHER", "") or file_of(item.nodeid)


def file_of(test):
    """Return the file of a test's name."""
    return test.partition("::")[0]


def processor_seconds():
    """Return the processors' time of this process and of its children that ended."""
    return sum(os.times()[:4])
