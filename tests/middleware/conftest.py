"""What tests of ROS's middlewares share; those marked ``own_network`` run in no network of others.

Cyclone DDS binds every interface that it finds.
"""

import time

import pytest
from namespace import entered


def pytest_configure(config):
    config.addinivalue_line("markers", "own_network: runs in a network namespace of its own")


@pytest.fixture(autouse=True)
def _apart(request):
    if request.node.get_closest_marker("own_network"):
        assert entered(), "not in a network of its own, which needs CAP_SYS_ADMIN: make test has one"


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
