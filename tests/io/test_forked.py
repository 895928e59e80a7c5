"""A result that is worked out in a forked process."""

import os
import signal
import sys

import pytest

from edoras_tools.errors import CaptureError
from edoras_tools.io.forked import Later

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere"),
]


def test_the_result_comes_from_another_process_and_is_kept():
    known = {"here": 1}

    def work():
        known["here"] = 2
        return os.getpid(), known["here"]

    later = Later(work, "it")
    assert not later.done
    process, there = later()
    assert later.done
    assert process != os.getpid()
    assert (there, known["here"]) == (2, 1)
    assert later() == (process, there)


def test_what_it_raises_comes_at_every_call():
    def work():
        raise CaptureError("no.pcap: bad")

    later = Later(work, "it")
    for _ in range(2):
        with pytest.raises(CaptureError, match=r"^no\.pcap: bad$"):
            later()


def test_one_that_is_killed_is_told():
    later = Later(lambda: os.kill(os.getpid(), signal.SIGKILL), "a.pcap: a process")
    with pytest.raises(CaptureError, match=r"^a\.pcap: a process was killed, perhaps"):
        later()
    with pytest.raises(ChildProcessError):
        os.waitpid(later._process, os.WNOHANG)


def test_where_no_process_can_be_forked_it_runs_here(monkeypatch):
    def none(*_):
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr("os.fork", none)
    later = Later(os.getpid, "it")
    assert later.done
    assert later() == os.getpid()
