"""Options as Cyclone DDS's configuration."""

from contextlib import ExitStack
from socket import AF_INET, SOCK_DGRAM, socket
from xml.etree import ElementTree as ET

import pytest
from namespace import ip
from ros_wheels import APART, Talk
from waiting import until

from edoras_tools.addons.dds.domain import (
    compatible,
    configuration,
    discovery,
    hold,
    missing_hint,
    one_choice,
    release,
)
from edoras_tools.addons.dds.graph import open_graph
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.ros import TypeStore


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


def test_types_of_fast_dds_3_are_matched_by_name():
    assert ET.fromstring(compatible()).findtext("Domain/Compatibility/IgnoreTypeInformation") == "1.15"


DISCOVERY = [
    ({}, None, None, []),
    ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, None, None, []),
    ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "ROS_STATIC_PEERS": "10.0.0.1"}, None, None, []),
    ({"ROS_STATIC_PEERS": "10.0.0.1; robot;"}, None, None, ["10.0.0.1", "robot"]),
    ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, "lo", "false", ["localhost"]),
    (
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "10.0.0.1"},
        None,
        "false",
        ["localhost", "10.0.0.1"],
    ),
    ({"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": "10.0.0.1"}, "lo", "false", ["localhost"]),
    ({"ROS_LOCALHOST_ONLY": "0"}, None, None, []),
    ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.1"}, "lo", "false", []),
]


@pytest.mark.parametrize(("environ", "interface", "multicast", "peers"), DISCOVERY)
def test_variables_of_ros(environ, interface, multicast, peers):
    domain = ET.fromstring(discovery(environ) or "<CycloneDDS/>")
    found = domain.find("Domain/General/Interfaces/NetworkInterface")
    assert (found.get("name") if found is not None else None) == interface
    assert domain.findtext("Domain/General/AllowMulticast") == multicast
    assert [peer.get("Address") for peer in domain.iter("Peer")] == peers
    assert (domain.findtext("Domain/Discovery/Tag") is not None) == ("OFF" in environ.values())


def test_ours_listens_where_others_look_for_it():
    for environ in ({}, {"ROS_STATIC_PEERS": "10.0.0.1"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}):
        assert ET.fromstring(discovery(environ)).findtext("Domain/Discovery/ParticipantIndex") == "auto"
    assert discovery({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}) == ""


def uri(inner):
    return f"<CycloneDDS><Domain><General>{inner}</General></Domain></CycloneDDS>"


RANGE, URI = "ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI"
LO = uri('<Interfaces><NetworkInterface name="lo"/></Interfaces>')
PEER = (
    '<CycloneDDS><Domain><Discovery><Peers><Peer Address="localhost"/></Peers></Discovery></Domain>'
    "</CycloneDDS>"
)
LOCALHOST = {RANGE: "LOCALHOST"}
FINDS = (
    # the range of a real node, our variables, our options
    ("LOCALHOST", {}, {}),
    ("LOCALHOST", {}, {"interface": "lo"}),
    ("LOCALHOST", {URI: LO}, {}),
    ("LOCALHOST", {URI: f"{LO},{PEER}"}, {}),
    ("LOCALHOST", LOCALHOST, {}),
    ("LOCALHOST", LOCALHOST, {"interface": "lo"}),
    ("LOCALHOST", LOCALHOST | {URI: LO}, {}),
    ("SUBNET", {}, {}),
    ("SUBNET", LOCALHOST, {}),
    ("SUBNET", {}, {"interface": "lo"}),
    ("SUBNET", LOCALHOST | {URI: LO}, {}),
    ("SUBNET", LOCALHOST | {URI: LO}, {"interface": "lo"}),
)


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_real_nodes_are_found_however_lo_is_named(name, monkeypatch):
    """In a namespace with another interface, which has the default route."""
    ip("link", "add", "outside", "type", "veth", "peer", "name", "far")
    try:
        for end in ("outside", "far"):
            ip("link", "set", end, "up")
        ip("addr", "add", "10.9.0.1/24", "dev", "outside")
        for reach in ("LOCALHOST", "SUBNET"):
            with Talk(name, **{RANGE: reach}) as talk:
                talk.tell(speak="/in", transient_local=True, depth=1)
                talk.tell(say=["/in"], **{"from": 0, "to": 1})
                for _, environ, options in (item for item in FINDS if item[0] == reach):
                    for variable in (RANGE, URI):
                        monkeypatch.delenv(variable, raising=False)
                    for variable, value in environ.items():
                        monkeypatch.setenv(variable, value)
                    heard = []
                    graph = open_graph(TypeStore(name), "bridge", domain=14, options=options)
                    try:
                        graph.subscribe("/in", "std_msgs/msg/String", Qos(None, None), heard.append)
                        until(lambda heard=heard: heard, f"{reach} {environ} {options}")
                    finally:
                        graph.close()
    finally:
        ip("link", "del", "outside")


@pytest.mark.own_network
@pytest.mark.parametrize(
    ("variables", "options"), [(LOCALHOST | {URI: LO}, {}), (LOCALHOST, {"interface": "lo"})]
)
def test_an_interface_is_named_by_one(variables, options, monkeypatch, tmp_path):
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    hold(78, configuration(options))
    release(78)
    if URI in variables:
        file = tmp_path / "uri.xml"
        file.write_text(LO)
        monkeypatch.setenv(URI, f"file://{file}")
        hold(78, configuration(options))
        release(78)


def test_what_names_an_interface_last_alone_does():
    old = uri("<NetworkInterfaceAddress>eth0</NetworkInterfaceAddress>")
    multicast = uri("<AllowMulticast>false</AllowMulticast>")
    assert one_choice(LO, "", PEER, multicast) == f"{LO},{PEER},{multicast}"
    assert one_choice(LO, old, LO) == f"{uri('')},{uri('')},{LO}"
    assert one_choice(LO, old, PEER) == f"{uri('')},{old},{PEER}"
    assert one_choice("", "") == ""


@pytest.mark.parametrize(
    ("environ", "words"),
    [
        (
            {},
            [
                "ROS_DOMAIN_ID",
                "If ROS_AUTOMATIC_DISCOVERY_RANGE is LOCALHOST there",
                "--ros-option interface=lo",
            ],
        ),
        (LOCALHOST, ["ROS_AUTOMATIC_DISCOVERY_RANGE limits ours to this machine", "unset it here"]),
        ({"ROS_LOCALHOST_ONLY": "1"}, ["ROS_LOCALHOST_ONLY limits ours", "unset it here"]),
        ({RANGE: "OFF"}, ["ROS_AUTOMATIC_DISCOVERY_RANGE is OFF here", "unset it"]),
    ],
)
def test_the_hint_of_who_finds_nobody_names_the_variable(environ, words):
    hint = missing_hint(environ)
    assert [word for word in words if word not in hint] == []


@pytest.mark.own_network
def test_a_domain_is_joined_where_all_its_ports_are_taken():
    with ExitStack() as taken:
        for port in range(7410 + 250 * 77, 7410 + 250 * 77 + 66, 2):
            taken.enter_context(socket(AF_INET, SOCK_DGRAM)).bind(("", port))
        hold(77, "")
        release(77)


def test_a_variable_that_ros_does_not_know():
    with pytest.raises(ConfigError) as caught:
        discovery({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"})
    assert str(caught.value) == (
        "ROS_AUTOMATIC_DISCOVERY_RANGE cannot be 'localhost'; "
        "set it to SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT"
    )
