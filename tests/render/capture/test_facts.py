from __future__ import annotations

from dataclasses import replace

import pytest

from edoras_tools.model import NO_MSG_ID, Peer
from edoras_tools.render.capture.facts import Facts, facts
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
    data = sbn.emit(sbn.MsgType.APP, Peer(66, 1), twist.datagram.payload)
    inner = replace(twist.layers[0], start=11, end=17)
    decoded = replace(twist, datagram=replace(twist.datagram, payload=data), layers=(head, inner))
    assert facts(decoded) == Facts("APP", 0x1827, "/cmd_vel")


def test_an_unknown_sbn_type_is_its_number(packets):
    data = sbn.emit(7, Peer(66, 3))
    decoded = packets["disconnect"]
    decoded = replace(decoded, datagram=replace(decoded.datagram, payload=data))
    assert facts(decoded).kind == "0x07"
