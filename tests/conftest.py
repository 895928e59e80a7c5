"""What all tests share: how they are drawn, and that none hangs."""

import faulthandler
import os
import signal
import sys

import pytest
from hypothesis import settings

# Machines differ and are shared: an example may take as long as it takes. The examples are the same in every
# run, so that a change is judged by what it changes; `make explore` draws new ones.
settings.register_profile("edoras", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "edoras"))

# What whoever runs the tests has set for their own terminal is not what the tests speak of.
for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR"):
    os.environ.pop(name, None)

LIMIT_S = 180
"""What a test may take; none takes a tenth of it where the machine is its own."""
GRACE_S = 60


def pytest_configure(config):
    config.addinivalue_line("markers", f"limit(seconds): what the test may take, {LIMIT_S} s else")
    config.stash[STDERR] = os.fdopen(os.dup(2), "w")  # pytest takes standard error away while tests run


STDERR = pytest.StashKey()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """Fail a test that hangs, with the stacks of all threads; end the session where not even that works."""
    marker = item.get_closest_marker("limit")
    limit = marker.args[0] if marker else LIMIT_S
    stderr = item.config.stash[STDERR]

    def ring(_number, _frame):
        faulthandler.dump_traceback(stderr)
        pytest.fail(f"it hangs: still at it after {limit} s; the stacks of its threads are on standard error")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, limit, GRACE_S / 3)  # again, should the end of the test hang too
    faulthandler.dump_traceback_later(limit + GRACE_S, exit=True, file=stderr)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """End a session that threads keep from ending."""
    config.stash[STDERR].close()
    faulthandler.dump_traceback_later(GRACE_S, exit=True, file=sys.__stderr__)
