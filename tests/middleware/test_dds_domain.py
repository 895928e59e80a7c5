"""Options as Cyclone DDS's configuration."""

from xml.etree import ElementTree as ET

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.dds_domain import configuration, hold


def test_without_options_nothing_is_configured():
    assert configuration({}) == ""


def test_options_become_configuration():
    domain = ET.fromstring(
        configuration({"interface": 'eth"0', "multicast": "false", "peers": "10.0.0.1, 10.0.0.2,"})
    )[0]
    assert domain.find("General/Interfaces/NetworkInterface").get("name") == 'eth"0'
    assert domain.findtext("General/AllowMulticast") == "false"
    assert domain.findtext("Discovery/ParticipantIndex") == "auto"
    assert [peer.get("Address") for peer in domain.iter("Peer")] == ["10.0.0.1", "10.0.0.2"]


def test_one_option_configures_one_thing():
    assert configuration({"interface": "lo"}) == (
        '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces></General>'
        "</Domain></CycloneDDS>"
    )


def test_all_mistakes_are_told_at_once():
    with pytest.raises(ConfigError) as caught:
        configuration({"iface": "lo", "multicast": "no"})
    assert caught.value.mistakes == (
        "--ros dds has no option 'iface'; there are interface, peers, multicast",
        "dds: multicast cannot be 'no'; write true or false",
    )


@pytest.mark.parametrize("number", [-1, 233])
def test_a_domain_that_has_no_ports_is_refused(number):
    with pytest.raises(ConfigError, match=f"dds: domain {number} does not exist; they are 0 to 232"):
        hold(number, "")
