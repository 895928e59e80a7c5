"""The file of EDORAS's ``data_transfer``: it is no bridge, and names the ports of two CFDP entities."""

import pytest

from edoras_tools.addons.cfdp.link import CFDP
from edoras_tools.decode import Context
from edoras_tools.errors import ConfigError
from edoras_tools.mission import TransferLink, loads
from edoras_tools.wire.ccsds import VERSION_2

FILE = """\
/**:
  ros__parameters:
    communication: {{bridge_port: 1235, fsw_port: 1234, fsw_ip: "127.0.0.1"}}
    {cfdp}
    write_data: ['tlm_scan_1']
    tlm_scan_1:
      type: "sensor_msgs/msg/LaserScan"
      topic: "/robot_1/scan"
      rate: 2000
      store_pkg: "data_transfer"
      store_filename: "data/scan_1"
"""
ENTITIES = 'cfdp: {ip: "127.0.0.1", port: 6111, entity_id: 1, ip_peer: "127.0.0.1", port_peer: 6222}'


def read(cfdp):
    return loads({"t.yaml": FILE.format(cfdp=cfdp).encode()})


def test_its_ports_are_those_of_the_link():
    mission = read(ENTITIES)
    assert mission.links == (TransferLink(6111, 6222, "t.yaml", 4),)
    assert (mission.routes, mission.bridges, mission.warnings) == ((), (), ())
    assert {5111, 5222, 6111, 6222} == {int(port) for port in Context(mission).ports[CFDP].nonzero()[0]}


def test_msg_ids_of_packets_with_pdus():
    mission = read("cfdp: {msg_ids: [0x18C8, 0x8C2, 0x8C2]}")
    assert (mission.pdu_msg_ids, mission.links) == ((0x18C8, 0x8C2), ())
    both = read(ENTITIES.replace("{", "{msg_ids: [0x18C8], ", 1))
    assert (both.pdu_msg_ids, len(both.links)) == ((0x18C8,), 1)
    context = Context(mission)
    assert (context.name(0x8C2), bool(context.known[0x8C2])) == ("CFDP_PDU", True)
    assert mission.numbered(VERSION_2).pdu_msg_ids == (VERSION_2.of_known(0x18C8), VERSION_2.of_known(0x8C2))


def test_entities_are_not_needed():
    assert read("read_data: ['x']").links == ()


@pytest.mark.parametrize(
    ("cfdp", "said"),
    [
        ("cfdp: {port: 6111}", "t.yaml:4: cfdp.port_peer: missing; an integer from 1 to 65535 is needed"),
        (
            "cfdp: {msg_ids: [0x2000]}",
            "t.yaml:4: cfdp.msg_ids: a list of MsgIds from 0x1 to 0x1FFF is needed",
        ),
        ("cfdp: {msg_ids: 0x18C8}", "t.yaml:4: cfdp.msg_ids: a list of MsgIds from 0x1 to 0x1FFF is needed"),
        (ENTITIES.replace("6222", "0"), "t.yaml:4: cfdp.port_peer: 0 is out of range"),
        (ENTITIES.replace("6222", "x"), "t.yaml:4: cfdp.port_peer:"),
    ],
)
def test_a_mistake_has_its_line(cfdp, said):
    with pytest.raises(ConfigError) as caught:
        read(cfdp)
    assert str(caught.value).startswith(said)
