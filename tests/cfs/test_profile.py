from __future__ import annotations

import pytest
from msgspec.structs import replace

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import ConfigError


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        ({"ci_port": 70000}, "ci_port: 70000 is not a UDP port"),
        ({"to_wake_ns": 0}, "to_wake_ns: 0 is not allowed"),
        ({"latency_ns": (5, 1)}, "latency_ns"),
        ({"cores": 0}, "cores: 0"),
    ],
)
def test_a_profile_that_cannot_run_is_refused_by_name(change, mistake):
    with pytest.raises(ConfigError, match=mistake):
        replace(SimProfile(), **change)


def test_the_defaults_are_those_of_the_flight_build():
    profile = SimProfile()
    assert (profile.ci_port, profile.to_port, profile.sbn_port) == (1234, 1235, 2234)
    assert str(profile.peer) == "66:1"
