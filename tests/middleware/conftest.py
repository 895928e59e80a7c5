"""What tests of ROS's middlewares share; those marked ``own_network`` run in no network of others.

Cyclone DDS binds every interface that it finds.
"""

import pytest
import waiting
from namespace import entered


def pytest_configure(config):
    config.addinivalue_line("markers", "own_network: runs in a network namespace of its own")


@pytest.fixture(autouse=True)
def _apart(request):
    if request.node.get_closest_marker("own_network"):
        assert entered(), "not in a network of its own, which needs CAP_SYS_ADMIN: make test has one"


@pytest.fixture
def until():
    """Wait for a condition."""
    return waiting.until
