"""Tests marked ``own_network`` run where only a loopback interface is: a network namespace of their own.

Cyclone DDS binds every interface that it finds. So this session starts another one, in a new namespace, for
the marked tests of a file, once, and reports each test's outcome as its own. ``unshare`` makes the
namespace for anybody; where it cannot, the tests fail and say why.
"""

import os
import subprocess
import sys
import tempfile
import time
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from places import ROOT

INSIDE = "EDORAS_OWN_NETWORK"
LIMIT = 300
ENTER = ("unshare", "--map-root-user", "--net", sys.executable, ".ci/with_raw_sockets.py", "--in-namespace")


def pytest_configure(config):
    config.addinivalue_line("markers", "own_network: runs in a network namespace of its own")


def pytest_collection_modifyitems(items):
    marked = [item for item in items if item.get_closest_marker("own_network")]
    if INSIDE in os.environ or not marked:
        return
    # Of one file: workers share tests out by files, and none runs what is another's.
    sessions = {
        path: OtherSession([item.nodeid for item in marked if item.path == path])
        for path in {item.path for item in marked}
    }
    items[:] = [
        Elsewhere.from_parent(item.parent, name=item.name, session_there=sessions[item.path])
        if item in marked
        else item
        for item in items
    ]


class OtherSession:
    """A pytest session in a namespace, over some tests."""

    def __init__(self, tests):
        self.tests = tests

    @cached_property
    def failures(self):
        """What went wrong, by test; tests that passed have an empty text."""
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder) / "report.xml"
            said = self._run(report)
            outcomes = {
                f"{case.get('classname')}.{case.get('name')}": "\n".join(
                    part.text or part.get("message") or part.tag
                    for part in case
                    if part.tag in {"failure", "error", "skipped"}
                )
                for case in (ET.parse(report).iter("testcase") if report.exists() else ())
            }
        return {test: outcomes.get(_key(test), f"not run in an own network: {said}") for test in self.tests}

    def _run(self, report):
        """Run the tests there; return what was said."""
        options = ("-q", "-p", "no:cacheprovider", f"--junitxml={report}")
        try:
            return subprocess.run(
                [*ENTER, sys.executable, "-m", "pytest", *options, *self.tests],
                cwd=ROOT,
                env=os.environ | {INSIDE: "1"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=LIMIT,
                check=False,
            ).stdout
        except (OSError, subprocess.TimeoutExpired) as error:
            return str(error)


class Elsewhere(pytest.Item):
    """A test whose outcome is known to another session."""

    def __init__(self, *, session_there, **options):
        super().__init__(**options)
        self.session_there = session_there
        self.add_marker(pytest.mark.limit(LIMIT + 60))  # the first waits for all

    def runtest(self):
        if failure := self.session_there.failures[self.nodeid]:
            pytest.fail(failure, pytrace=False)

    def reportinfo(self):
        return self.path, None, self.name


def _key(test):
    """Return a test's name as the report has it."""
    file, _, name = test.partition("::")
    return f"{file.removesuffix('.py').replace('/', '.')}.{name.replace('::', '.')}"


@pytest.fixture
def until():
    """Wait for a condition; fail where it does not come true in half a minute."""

    def wait(condition, seconds=30):
        end = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < end, "what was waited for did not happen"
            time.sleep(0.005)
        return found

    return wait
