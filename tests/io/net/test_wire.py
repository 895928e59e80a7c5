from __future__ import annotations

import gc
import itertools
import os
import socket

import pytest
from waiting import HOST, PATIENCE_S

from edoras_tools.io.net.transmit import Listener, Transmitter
from edoras_tools.io.net.wire import UdpWire, precise_timing
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint
from edoras_tools.sessions.outgoing import Outgoing, Packet


@pytest.fixture
def ends():
    """A wire, the socket at its other end, and its listener."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, 0))
        other.settimeout(PATIENCE_S)
        ear = Listener(Endpoint(HOST, 0))
        with Transmitter(Endpoint(HOST, other.getsockname()[1])) as transmitter:
            yield UdpWire(transmitter, SBN, [(TO, ear)]), other, ear, transmitter
        ear.close()


def test_a_wait_ends_when_its_time_has_come_not_before(ends):
    wire = ends[0]
    until = wire.now() + 3_000_000
    assert wire.wait(until)
    assert wire.now() >= until
    assert wire.wait(until - 10**9)  # past


def test_a_wait_ends_early_when_something_arrives(ends):
    wire, other, ear, transmitter = ends
    until = wire.now() + 60 * 10**9
    other.sendto(b"telemetry", (HOST, ear.local.port))
    assert not wire.wait(until)
    other.sendto(b"answer", (HOST, transmitter.local.port))
    sender = Endpoint(*other.getsockname())
    assert wire.receive() == [
        (SBN, b"answer", sender, transmitter.local),
        (TO, b"telemetry", sender, ear.local),
    ]
    assert wire.now() < until


def test_a_watched_descriptor_ends_a_wait_too(ends):
    reading, writing = os.pipe()
    os.write(writing, b"q")
    wire = UdpWire(ends[3], CI, (), [reading])
    assert not wire.wait(wire.now() + 60 * 10**9)
    os.close(reading)
    os.close(writing)


def test_one_and_many_are_sent(ends):
    wire, other, *_ = ends
    out = Outgoing.packets(CI, [Packet(bytes([index]) * 8) for index in range(5)])
    assert wire.send(out, 1, 2) == 1
    assert wire.send(out, 2, 5) == 3
    assert wire.put(b"own")
    assert [other.recv(10) for _ in range(5)] == [*(bytes([index]) * 8 for index in range(1, 5)), b"own"]
    assert wire.statistics.sent == 5


def test_sending_is_rehearsed_until_shortly_before_a_deadline(ends, monkeypatch):
    wire, other, _, transmitter = ends
    out, rehearsed = Outgoing.packets(CI, [Packet(b"first"), Packet(b"second")]), []
    ticks = itertools.count(0, 1000)

    def rehearse(payload):
        rehearsed.append((bytes(payload), next(ticks)))
        Transmitter.rehearse(transmitter, payload)

    monkeypatch.setattr(wire, "now", lambda: next(ticks))
    monkeypatch.setattr(transmitter, "rehearse", rehearse)
    assert wire.wait(100_000)
    assert not rehearsed  # nothing was sent yet
    wire.send(out, 0, 1)
    assert wire.wait(200_000)
    wire.send(out, 1, 2)
    assert {payload for payload, _ in rehearsed} == {b"first"}
    assert 185_000 < rehearsed[-1][1] < 195_000
    assert [other.recv(10), other.recv(10)] == [b"first", b"second"]
    assert wire.statistics.sent == 2


def test_the_garbage_collector_is_given_back_as_it_was():
    with precise_timing():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with precise_timing():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
