"""Constants of cFS on the command line."""

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.mission import FlightSoftware
from edoras_tools.pipelines.workbench import read_constants


def test_constants_are_named():
    assert read_constants(["app_msg_limit=0x10"]) == {"app_msg_limit": 16}
    for text, words in (
        ("app_limit=3", "did you mean app_msg_limit"),
        ("app_msg_limit=many", "is not a whole number"),
        ("seed", "is not a whole number"),
        ("cores=0", "1 or more"),
    ):
        with pytest.raises(ConfigError, match=words):
            read_constants([text])


def test_the_command_line_says_more_than_a_file():
    file = FlightSoftware({"ci_wake_ns": 1, "app_msg_limit": 2}, {0x0827: 3})
    both = file.stating(read_constants(["app_msg_limit=7"])).profile
    assert (both.ci_wake_ns, both.app_msg_limit, both.to_limits[0x0827]) == (1, 7, 3)
    assert both.stated == {"ci_wake_ns", "app_msg_limit", 0x0827}
