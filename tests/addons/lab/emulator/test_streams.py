"""Emulated cFS as SBN peers over TCP: who connects, who listens, and what relays and replays between them."""

from __future__ import annotations

import signal
import socket

import pytest
from places import CAPTURES
from waiting import HOST, Program, free_ports, until
from warm import EDORAS

from edoras_tools.addons.lab.emulator import Served, Simulation, streams
from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.msg_id import VERSION_1

FIRST, OTHER, BRIDGE = Peer(0x42, 1), Peer(0x42, 2), Peer(0x42, 3)


@pytest.fixture
def ports(monkeypatch):
    monkeypatch.setattr(streams, "_CONNECT_NS", 200 * MILLISECOND)
    return free_ports(3, socket.SOCK_STREAM)


def cfs(peer, port, *peers):
    """An emulated cFS, and the MsgIds that came from its peers, in order."""
    ci, to = free_ports(2)
    profile = SimProfile(
        processor_id=peer.processor_id,
        sbn_tcp=1,
        sbn_port=port,
        sbn_peers=tuple(SbnPeerConfig(*item) for item in peers),
        sbn_wake_ns=25 * MILLISECOND,
        housekeeping_ns=50 * MILLISECOND,
        ci_port=ci,
        to_port=to,
    )
    simulation = Simulation(profile, "two-rovers", bridges=False)
    heard, publish = [], simulation.cfs.publish

    def note(packet, sender, *, stamp=True):
        if sender == "SBN" and not stamp:
            heard.append(VERSION_1.of(packet))
        return publish(packet, sender, stamp=stamp)

    simulation.cfs.publish = note
    return simulation, heard


def connected(simulation, peer):
    return simulation.apps.sbn.node.peers[peer].connected


def test_messages_cross_both_ways_and_a_lost_peer_comes_back(ports):
    one, from_other = cfs(FIRST, ports[0], (OTHER, ports[1]))
    with Served(one):
        for _ in range(2):  # the smaller ProcessorID goes on trying
            other, from_first = cfs(OTHER, ports[1], (FIRST, ports[0]))
            from_other.clear()
            with Served(other):
                until(lambda heard=from_first: 0x803 in heard and 0x803 in from_other)
                assert connected(one, OTHER)
                assert connected(other, FIRST)
            until(lambda: not connected(one, OTHER))


def test_a_relay_between_two_and_a_replay_to_one(call, ports):
    own, relay, far = ports
    one, heard = cfs(FIRST, own, (OTHER, relay), (BRIDGE, free_ports(1)[0]))
    other, _ = cfs(OTHER, far, (FIRST, own))
    ends = ("--listen", f"{HOST}:{relay}", "--target", f"{HOST}:{far}")
    with Program(EDORAS, "proxy", "sbn", "--tcp", *ends) as proxy, Served(one), Served(other):
        until(lambda: 0x803 in heard)
        assert connected(other, FIRST)
        words = ("--to", "sbn", "--tcp", "--as", "66:3", "--msg-id", "0x1829", "--count", 40, "--rate", 100)
        ends = ("--linger", "0.1s", "--target", f"{HOST}:{own}")
        done = call("replay", CAPTURES / "f_sbn_disconnect.pcap", *words, *ends)
        assert done.code == 0, done.err
        until(lambda: not connected(one, BRIDGE))
        assert heard.count(0x1829) == 40
        proxy.process.send_signal(signal.SIGINT)
        assert "1 connection: " in proxy.err.rest()


def test_what_cannot_be(ports):
    with pytest.raises(ConfigError, match="flight bridge speaks SBN over UDP alone"):
        Simulation(SimProfile(sbn_tcp=1), "two-rovers")
    one, _ = cfs(FIRST, ports[0])
    with socket.socket() as other:
        other.bind((HOST, ports[0]))
        other.listen()
        with pytest.raises(CaptureError, match=r"TCP .* cannot be bound: another program"), Served(one):
            pass
