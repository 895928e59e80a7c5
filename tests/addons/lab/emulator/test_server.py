from __future__ import annotations

import signal
import socket

import pytest
from msgspec.structs import replace
from places import CAPTURES
from waiting import HOST, PATIENCE_S, Program, free_ports, until
from warm import EDORAS

from edoras_tools.addons.lab.emulator import Served, Simulation, serve, simulation
from edoras_tools.cfs.profile import Ports, SbnPeerConfig, SimProfile
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.ccsds import VERSION_1


@pytest.fixture
def profile():
    """A hasty one: every period of the flight side is twenty times shorter."""
    fast = 25 * MILLISECOND
    return SimProfile(
        ci_wake_ns=fast,
        to_wake_ns=fast,
        sbn_wake_ns=fast,
        housekeeping_ns=2 * fast,
    ).on(Ports(*free_ports(4)))


def test_ground_enables_telemetry_and_is_answered_on_real_sockets(profile):
    seen = set()
    with (
        Served(Simulation(profile, "rover", bridges=False)),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground,
    ):
        ground.bind((HOST, profile.to_port))
        ground.settimeout(PATIENCE_S)
        ci = (HOST, profile.ci_port)
        ground.sendto(cfe.emit_command(0x1880, 6, HOST.encode().ljust(16, b"\0")), ci)
        ground.recv(2048)
        ground.sendto(cfe.emit_command(0x1884, 0), ci)
        ground.sendto(b"short", ci)

        def complete():
            packet = ground.recv(2048)
            seen.add(packet[:2].hex())
            seen.update(word for word in ("NOOP", "dropped") if word.encode() in packet)
            return seen >= {"0800", "0803", "0827", "NOOP", "dropped"}

        until(complete, lambda: seen)


def test_a_peer_subscribes_on_a_real_socket(profile):
    kinds = set()
    with (
        Served(Simulation(profile, "two-rovers", bridges=False)),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge,
    ):
        bridge.bind((HOST, profile.sbn_peers[0].port))
        bridge.settimeout(PATIENCE_S)
        wanted = sbn.emit_subscriptions([sbn.Subscription(0x0803)])
        bridge.sendto(sbn.emit(sbn.MsgType.SUB, Peer(0x42, 3), wanted), (HOST, profile.sbn_port))

        def complete():
            kinds.add(bridge.recv(2048)[2])
            return kinds >= {sbn.MsgType.PROTO, sbn.MsgType.SUB, sbn.MsgType.APP}

        until(complete, lambda: kinds)


def test_a_demo_runs_on_its_own(profile):
    simulation = Simulation(profile, "two-rovers", command_rate_hz=20, state_rate_hz=20)
    with Served(simulation):
        until(lambda: simulation.ground.received)
        until(lambda: simulation.apps.sbn.node.peers[Peer(0x42, 3)].connected)


def test_an_error_of_who_watches_is_not_taken_for_one_of_a_socket(profile):
    class FullDisk:
        def received(self, endpoint, data):
            raise OSError("no space left")

        def sent(self, item):
            pass

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        command = cfe.emit_command(0x1884, 0)
        send = lambda: ground.sendto(command, (HOST, profile.ci_port))  # noqa: E731
        simulation = Simulation(profile, "rover", bridges=False)
        with pytest.raises(OSError, match="no space left"):
            serve(simulation, HOST, duration=PATIENCE_S, ready=send, watch=FullDisk())


def test_it_says_when_it_is_ready_and_ends_after_its_duration(profile):
    told = []
    assert serve(Simulation(profile), HOST, duration=0.3, ready=lambda: told.append("ready")) >= 0
    assert told == ["ready"]


def test_a_port_in_use_is_one_clear_line(profile):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, profile.ci_port))
        with pytest.raises(CaptureError) as caught:
            serve(Simulation(profile, bridges=False), HOST, duration=1)
        with pytest.raises(CaptureError) as again, Served(Simulation(profile, bridges=False)):
            pytest.fail("a port in use is not served")
    assert str(again.value) == str(caught.value)
    assert str(caught.value) == (
        f"UDP 127.0.0.1:{profile.ci_port}: cannot be bound: another program has port {profile.ci_port}"
        " (a bridge?): stop it, or choose another host, as 127.0.0.2"
    )


def test_an_address_that_is_not_the_host_s_is_one_clear_line(profile):
    with pytest.raises(CaptureError, match=r"UDP 192\.0\.2\.1:\d+: cannot be bound"):
        serve(Simulation(replace(profile), bridges=False), "192.0.2.1", duration=1)


FIRST, OTHER, BRIDGE = Peer(0x42, 1), Peer(0x42, 2), Peer(0x42, 3)


@pytest.fixture
def ports(monkeypatch):
    monkeypatch.setattr(simulation, "_CONNECT_NS", 200 * MILLISECOND)
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
