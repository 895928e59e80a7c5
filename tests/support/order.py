"""Which file of tests runs when: the longest of the last whole run first, so that none is left at the end.

The seconds of each file are kept where pytest keeps what it knows of the last run; ``pytest --cache-clear``
forgets them. Those of the slowest are printed behind a whole run.
"""

from __future__ import annotations

from collections import Counter

import pytest

KEY = "edoras/seconds of files"
SHOWN = 15


class Order:
    """A plugin: sorts by the seconds of the last whole run, and takes those of this one."""

    def __init__(self, config):
        self._cache = getattr(config, "cache", None)  # none with -p no:cacheprovider
        whole = config.args_source is config.ArgsSource.TESTPATHS
        self._whole = whole and not config.option.keyword and not config.option.markexpr
        self._seconds = Counter()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        """Sort the files, each a whole; one that never ran is as long as its tests are many."""
        before = self._cache.get(KEY, {}) if self._cache else {}
        many = Counter(map(file_of, (item.nodeid for item in items)))
        items.sort(key=lambda item: -before.get(file_of(item.nodeid), many[file_of(item.nodeid)] / 20))

    def pytest_runtest_logreport(self, report):
        """Count what a part of a test took."""
        self._seconds[file_of(report.nodeid)] += report.duration

    def pytest_terminal_summary(self, terminalreporter):
        """Print and keep the seconds of the files of a whole run."""
        if self._whole and self._seconds:
            if self._cache:
                self._cache.set(KEY, {name: round(seconds, 2) for name, seconds in self._seconds.items()})
            terminalreporter.section(f"slowest {SHOWN} files of {len(self._seconds)}")
            for name, seconds in self._seconds.most_common(SHOWN):
                terminalreporter.write_line(f"{seconds:6.1f} s  {name}")


def file_of(test):
    """Return the file of a test's name."""
    return test.partition("::")[0]
