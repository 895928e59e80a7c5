"""JUnit XML as an independent reader reads it, whatever texts a capture holds."""

import pytest

from edoras_tools.addons.runs.check import CheckResult, junit, write_junit
from edoras_tools.errors import CaptureError

junitparser = pytest.importorskip("junitparser")

RESULTS = (
    CheckResult("/a", "count", "at least 1", "7 messages", passed=True),
    CheckResult("/a", "always x < 1 & y > 2", None, 'the "first" is \x1b[31m\0\ud800', passed=False),
)
NAMES = "check", "expect <1>.yaml", "run \x07.pcap"


def test_what_an_independent_reader_reads():
    (suite,) = junitparser.JUnitXml.fromstring(junit(RESULTS, NAMES, 12.5))
    assert (suite.name, suite.tests, suite.failures, suite.time) == ("expect <1>.yaml", 2, 1, 12.5)
    good, bad = suite
    assert (good.classname, good.name, good.is_passed) == ("/a", "count: at least 1", True)
    assert (bad.name, bad.is_passed) == ("always x < 1 & y > 2", False)
    assert bad.result[0].message == 'the "first" is \\x1b[31m\\x00\\ud800'
    assert [item.value for item in suite.properties()] == ["run \\x07.pcap"]


def test_the_folder_is_made(tmp_path):
    write_junit(tmp_path / "new/results.xml", RESULTS, NAMES)
    assert junitparser.JUnitXml.fromfile(str(tmp_path / "new/results.xml")).tests == 2


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(CaptureError, match="cannot be written"):
        write_junit(tmp_path, RESULTS, NAMES)
