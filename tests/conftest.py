"""What all tests share: how they are drawn, and that none hangs."""

import contextlib
import faulthandler
import gc
import os
import signal
import sys

import pytest
import waiting
from effort import examples, split, unmatched
from hypothesis import settings
from namespace import enter, entered
from order import Order

# Machines differ and are shared: an example may take as long as it takes. The examples are the same in every
# run, so that a change is judged by what it changes; `make explore` draws new ones.
settings.register_profile("edoras", deadline=None, derandomize=True, max_examples=examples(100))
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "edoras"))

# To look for garbage more often takes up to a sixth of all the time, and finds next to none.
gc.set_threshold(1_000_000)

# A screen is drawn five times a second at the most, not sixty: that is a third of what views take.
os.environ.setdefault("TEXTUAL_FPS", "5")

# What whoever runs the tests has set for their own terminal is not what the tests speak of.
for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "COLORFGBG", "ROS_DISTRO"):
    os.environ.pop(name, None)

# Nor is what a shell has them ignore in the background, or nohup: what a test starts would ignore it too. A
# hang-up ends the tests only where it did before.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

# Each worker of a session has a network of its own, so that no test meets the traffic of another or takes its
# port. Where that is not allowed, tests that must not run in the network of others fail, and say why.
with contextlib.suppress(OSError):
    enter()

pytest_plugins = ["workers"]

LIMIT_S = 600
"""What a test may take before it is taken to hang; none takes a thirtieth of it on an idle machine."""
GRACE_S = 60


def pytest_configure(config):
    config.addinivalue_line("markers", f"limit(seconds): what the test may take, {LIMIT_S} s else")
    config.addinivalue_line("markers", "long(*patterns): only `make long` runs it, or its cases that match")
    config.addinivalue_line("markers", "each(number): `make test` runs one of so many of its cases")
    config.addinivalue_line("markers", "quick(*patterns): `make test` runs its cases that match one")
    config.addinivalue_line("markers", "own_network: it fails where it would meet the traffic of others")
    config.pluginmanager.register(Order(config))
    config.stash[STDERR] = os.fdopen(os.dup(2), "w")  # pytest takes standard error away while tests run


STDERR = pytest.StashKey()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Leave what takes long to ``make long``.

    Raises:
        UsageError: a pattern matches no case.
    """
    if not any("::" in word for word in config.args) and (wrong := unmatched(items)):
        raise pytest.UsageError(*(f"{test}: no case matches {pattern!r}" for test, pattern in wrong))
    items[:], left = split(items)
    if left:
        config.hook.pytest_deselected(items=left)


def pytest_runtest_setup(item):
    """Cyclone DDS binds every interface that it finds."""
    if item.get_closest_marker("own_network"):
        assert entered(), "not in a network of its own, which needs CAP_SYS_ADMIN: make test has one"


@pytest.fixture
def until():
    """Wait for a condition."""
    return waiting.until


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
