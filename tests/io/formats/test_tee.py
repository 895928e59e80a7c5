from __future__ import annotations

import pytest

from edoras_tools.errors import CaptureError
from edoras_tools.io import Sink
from edoras_tools.io.formats.tee import Tee
from edoras_tools.model import SourceStatistics


class Written(Sink):
    def __init__(self, failure=None):
        self.calls = []
        self._failure = failure

    def write(self, batch, columns):
        self.calls.append(("write", batch, columns))

    def flush(self):
        self.calls.append("flush")

    def close(self, statistics):
        self.calls.append(("close", statistics))
        if self._failure:
            raise self._failure


class Faulty(Written):
    def write_faults(self, faults):
        self.calls.append(("faults", faults))


def test_all_get_everything_that_they_can_hold():
    plain, faulty, statistics = Written(), Faulty(), SourceStatistics()
    tee = Tee([plain, faulty])
    tee.write("batch", "columns")
    tee.write_faults(["fault"])
    tee.flush()
    tee.close(statistics)
    common = [("write", "batch", "columns"), "flush", ("close", statistics)]
    assert plain.calls == common
    assert faulty.calls == [common[0], ("faults", ["fault"]), *common[1:]]


def test_all_are_closed_whatever_becomes_of_one():
    one, other = Written(CaptureError("full")), Written(CaptureError("gone"))
    with pytest.raises(CaptureError):
        Tee([one, other]).close(SourceStatistics())
    assert one.calls
    assert other.calls
