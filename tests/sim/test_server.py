from __future__ import annotations

import socket
import threading
from dataclasses import replace

import pytest

from edoras_tools.errors import CaptureError
from edoras_tools.sessions.profile import MILLISECOND, SbnPeerConfig, SimProfile
from edoras_tools.sim import Simulation, serve
from edoras_tools.wire import cfe, sbn

HOST = "127.0.0.1"


@pytest.fixture
def free_ports():
    def take(count: int) -> list[int]:
        opened = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
        for item in opened:
            item.bind((HOST, 0))
        ports = [item.getsockname()[1] for item in opened]
        for item in opened:
            item.close()
        return ports

    return take


@pytest.fixture
def profile(free_ports):
    """A hasty one: every period of the flight side is twenty times shorter."""
    ci, to, own, peer = free_ports(4)
    fast = 25 * MILLISECOND
    return SimProfile(
        ci_port=ci,
        to_port=to,
        sbn_port=own,
        sbn_peers=(SbnPeerConfig(sbn.Peer(0x42, 3), peer),),
        ci_wake_ns=fast,
        to_wake_ns=fast,
        sbn_wake_ns=fast,
        housekeeping_ns=2 * fast,
    )


def serving(simulation):
    """Serve in a thread; return once ready, with what ends it."""
    ready, stop, failures = threading.Event(), threading.Event(), []

    def run():
        try:
            serve(simulation, HOST, duration=20, stop=stop, ready=ready.set)
        except BaseException as error:  # noqa: BLE001  handed to the test's thread
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(5)

    def end():
        stop.set()
        thread.join(5)
        assert not thread.is_alive()
        assert not failures

    return end


def test_ground_enables_telemetry_and_is_answered_on_real_sockets(profile):
    end = serving(Simulation(profile, "rover", bridges=False))
    seen = set()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
            ground.bind((HOST, profile.to_port))
            ground.settimeout(10)
            ci = (HOST, profile.ci_port)
            ground.sendto(cfe.emit_command(0x1880, 6, HOST.encode().ljust(16, b"\0")), ci)
            ground.recv(2048)
            ground.sendto(cfe.emit_command(0x1884, 0), ci)
            ground.sendto(b"short", ci)
            while not seen >= {"0800", "0803", "0827", "NOOP", "dropped"}:
                packet = ground.recv(2048)
                seen.add(packet[:2].hex())
                seen |= {word for word in ("NOOP", "dropped") if word.encode() in packet}
    finally:
        end()


def test_a_peer_subscribes_on_a_real_socket(profile):
    end = serving(Simulation(profile, "two-rovers", bridges=False))
    kinds = set()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
            bridge.bind((HOST, profile.sbn_peers[0].port))
            bridge.settimeout(10)
            wanted = sbn.emit_subscriptions([sbn.Subscription(0x0803)])
            bridge.sendto(sbn.emit(sbn.MsgType.SUB, sbn.Peer(0x42, 3), wanted), (HOST, profile.sbn_port))
            while not kinds >= {sbn.MsgType.PROTO, sbn.MsgType.SUB, sbn.MsgType.APP}:
                kinds.add(bridge.recv(2048)[2])
    finally:
        end()


def test_a_demo_runs_for_its_duration_and_says_when_it_is_ready(profile):
    simulation = Simulation(profile, "two-rovers", command_rate_hz=20, state_rate_hz=20)
    told = []
    sent = serve(simulation, HOST, duration=1.6, ready=lambda: told.append("ready"))
    assert told == ["ready"]
    assert sent > 0
    assert simulation.ground.received
    assert simulation.cfs.sbn.node.peers[sbn.Peer(0x42, 3)].connected


def test_a_port_in_use_is_one_clear_line(profile):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, profile.ci_port))
        with pytest.raises(CaptureError) as caught:
            serve(Simulation(profile, bridges=False), HOST, duration=1)
    assert str(caught.value) == (
        f"UDP 127.0.0.1:{profile.ci_port} cannot be bound: Address already in use;"
        " stop what uses it, or choose other ports"
    )


def test_an_address_that_is_not_the_host_s_is_one_clear_line(profile):
    with pytest.raises(CaptureError, match=r"UDP 192\.0\.2\.1:\d+ cannot be bound"):
        serve(Simulation(replace(profile), bridges=False), "192.0.2.1", duration=1)
