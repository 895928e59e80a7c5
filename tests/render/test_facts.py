from __future__ import annotations

from dataclasses import replace

import pytest

from edoras_tools.model import NO_MSG_ID, LayerField
from edoras_tools.render.facts import Facts, facts
from edoras_tools.wire import sbn


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("twist", Facts("cmd", 0x1827, "/cmd_vel")),
        ("event", Facts("tlm", 0x0808, "EVS_LONG_EVENT")),
        ("subscriptions", Facts("SUB", NO_MSG_ID, "")),
        ("disconnect", Facts("DISCONNECT", NO_MSG_ID, "")),
        ("truncated", Facts("cmd", 0x1827, "/cmd_vel")),
    ],
)
def test_facts(packets, name, expected):
    assert facts(packets[name]) == expected


def test_a_packet_inside_sbn_keeps_the_outer_kind(packets):
    twist, head = packets["twist"], packets["disconnect"].layers[0]
    data = sbn.emit(sbn.MsgType.APP, sbn.Peer(66, 1), twist.datagram.payload)
    inner = replace(twist.layers[0], start=11, end=17)
    decoded = replace(twist, datagram=replace(twist.datagram, payload=data), layers=(head, inner))
    assert facts(decoded) == Facts("APP", 0x1827, "/cmd_vel")


def test_an_unknown_sbn_type_is_its_number(packets):
    data = sbn.emit(7, sbn.Peer(66, 3))
    decoded = packets["disconnect"]
    decoded = replace(decoded, datagram=replace(decoded.datagram, payload=data))
    assert facts(decoded).kind == "0x07"


def test_with_the_extended_header_the_msg_id_is_not_the_first_word(packets):
    twist = packets["twist"]
    field = LayerField("msg_id", 0x2A7, 0, 2, "0x02a7 /extended")
    decoded = replace(twist, layers=(replace(twist.layers[0], fields=(field,)),), message=None)
    assert facts(decoded) == Facts("cmd", 0x2A7, "/extended")
