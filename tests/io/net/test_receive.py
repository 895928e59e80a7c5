"""Plain UDP sockets as a source."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

import pytest
from waiting import until

from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.io.net import buffer as udp
from edoras_tools.io.net import sockets
from edoras_tools.io.net.buffer import Sockets, UdpSource
from edoras_tools.model import Endpoint

LOCAL = Endpoint("127.0.0.1", 0)
LOCAL6 = Endpoint("::1", 0)


@pytest.fixture(scope="module", autouse=True)
def _stamped():
    """The kernel stamps what comes from a while after the first socket has asked for it, while one does."""
    with contextlib.closing(Sockets([LOCAL])) as own:

        def at_once():
            send(own.endpoints[0], b"x")
            after = time.time_ns()
            return until(own.read).time_ns[0] <= after

        until(at_once, "datagrams are stamped when they come")
        yield


@pytest.fixture
def listen():
    sources = []

    def make(*endpoints, **options):
        sources.append(UdpSource(endpoints, **options))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def send(endpoint, *datagrams):
    """Send to an endpoint; return where from."""
    family = socket.AF_INET6 if ":" in endpoint.address else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sender:
        sender.connect((endpoint.address, endpoint.port))
        for datagram in datagrams:
            sender.send(datagram)
        return Endpoint(*sender.getsockname()[:2])


def received(source):
    source.stop()
    return [batch[row] for batch in source.batches() for row in range(len(batch))]


@pytest.mark.parametrize(("local", "header"), [(LOCAL, 28), (LOCAL6, 48)])
def test_a_datagram_looks_captured(listen, local, header):
    source = listen(local)
    (here,) = source.endpoints
    before = time.time_ns()
    sender = send(here, b"\x18\x27 a command", b"", b"odd")
    after = time.time_ns()
    seen = received(source)
    assert [datagram.payload for datagram in seen] == [b"\x18\x27 a command", b"", b"odd"]
    for number, datagram in enumerate(seen, 1):
        assert datagram.number == number
        assert before <= datagram.time_ns <= after
        assert (datagram.source, datagram.destination) == (sender, here)
        assert datagram.link_type == 101
        assert datagram.payload_offset == header
        assert len(datagram.frame) == datagram.original_length == header + len(datagram.payload)
        assert not datagram.findings
    statistics = source.statistics
    assert (statistics.frames, statistics.datagrams, statistics.skipped) == (3, 3, 0)
    assert (source.info.name, source.info.kind) == (str(here), "udp")


@pytest.mark.parametrize("size", [1, 1500, 9000, 65507])
def test_any_size(listen, size):
    source = listen(LOCAL)
    send(source.endpoints[0], b"\x5a" * size)
    assert [datagram.payload for datagram in received(source)] == [b"\x5a" * size]


def test_many_of_several_sockets_in_time_order(listen):
    source = listen(LOCAL, LOCAL6, LOCAL)
    wanted = []
    for number in range(200):
        for endpoint in source.endpoints:
            payload = struct.pack(">H", number) + str(endpoint).encode()
            send(endpoint, payload)
            wanted.append(payload)
    seen = received(source)
    assert [datagram.payload for datagram in seen] == wanted
    assert [datagram.number for datagram in seen] == list(range(1, 601))
    assert source.info.name == ", ".join(str(endpoint) for endpoint in source.endpoints)


def test_what_comes_between_two_sockets_stays_in_time_order(monkeypatch):
    with contextlib.closing(Sockets([LOCAL, LOCAL6])) as sockets:
        first, second = sockets.endpoints
        send(first, b"1")
        drain = sockets._drain

        def and_then_others_come(bound, page):
            whole = drain(bound, page)
            if bound.version == 4:
                monkeypatch.setattr(sockets, "_drain", drain)
                send(first, b"2", b"22")
                send(second, b"3", b"33")
            return whole

        monkeypatch.setattr(sockets, "_drain", and_then_others_come)
        seen = []
        while (frames := sockets.read()) is not None:
            batch = demux(frames)
            seen.append([batch[row].payload for row in range(len(batch))])
        assert seen == [[b"1"], [b"2", b"22", b"3", b"33"]]


def test_the_address_it_was_sent_to(listen):
    source = listen(Endpoint("0.0.0.0", 0))
    port = source.endpoints[0].port
    for address in ("127.0.0.1", "127.1.2.3"):
        send(Endpoint(address, port), b"x")
    assert [str(datagram.destination) for datagram in received(source)] == [
        f"127.0.0.1:{port}",
        f"127.1.2.3:{port}",
    ]


def test_both_wildcards_together(listen):
    (four,) = listen(Endpoint("0.0.0.0", 0)).endpoints
    listen(Endpoint("::", four.port))


def test_a_name(listen):
    source = listen(Endpoint("localhost", 0))
    send(source.endpoints[0], b"by name")
    assert [datagram.payload for datagram in received(source)] == [b"by name"]


def test_what_the_kernel_dropped_is_counted():
    sockets = Sockets([LOCAL], receive_buffer=8192)
    try:
        send(sockets.endpoints[0], *[bytes(1000)] * 200)
        frames = sockets.read()
        sockets.count()
        assert 0 < len(frames) < 200
        assert len(frames) + sockets.drops == 200
        assert sockets.read() is None
    finally:
        sockets.close()


def test_after_stop_nobody_gets_in():
    sockets = Sockets([LOCAL, LOCAL6])
    try:
        for endpoint in sockets.endpoints:
            send(endpoint, b"early")
        sockets.refuse()
        for endpoint in sockets.endpoints:
            send(endpoint, b"late")
        assert len(sockets.read()) == 2
        assert sockets.read() is None
    finally:
        sockets.close()


def test_a_long_queue_comes_in_several_reads(monkeypatch):
    monkeypatch.setattr(udp, "_READ_BYTES", 5000)
    sockets = Sockets([LOCAL, LOCAL])
    wanted = [struct.pack(">H", number) for number in range(600)]
    try:
        for number, payload in enumerate(wanted):
            send(sockets.endpoints[number % 2], payload)
        seen = []
        while (frames := sockets.read()) is not None:
            batch = demux(frames)
            seen.append([batch[row].payload for row in range(len(batch))])
        assert [payload for payloads in seen for payload in payloads] == wanted
        assert len(seen) == 2
    finally:
        sockets.close()


def test_a_port_that_is_taken(listen):
    (taken,) = listen(LOCAL).endpoints
    with pytest.raises(
        CaptureError, match=rf"^{taken}: cannot be bound: another program has port {taken.port} .*-i"
    ):
        listen(LOCAL, taken)


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        (Endpoint("192.0.2.1", 1234), "not an address of this machine"),
        (Endpoint("127.0.0.1", 70000), "0 to 65535"),
        (Endpoint("127.0.0.1", -1), "0 to 65535"),
        (Endpoint("not an address", 1234), "neither an address"),
        (Endpoint("..", 1234), "neither an address"),
    ],
)
def test_an_endpoint_that_cannot_be(listen, endpoint, why):
    with pytest.raises(CaptureError) as caught:
        listen(endpoint)
    assert str(caught.value).startswith(f"{endpoint}: ")
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_endpoint():
    with pytest.raises(CaptureError, match="HOST:PORT"):
        UdpSource([])


def test_ready_and_silence(listen):
    said = []
    source = listen(LOCAL, ready=lambda: said.append(1))
    batches = source.batches()
    assert len(next(batches)) == 0
    assert said == [1]
    assert source.started.is_set()


def test_another_system(listen, monkeypatch):
    # Without Linux's extras the time is taken here and the destination is what was bound.
    monkeypatch.setattr(sockets, "LINUX", False)
    source = listen(LOCAL)
    before = time.time_ns()
    send(source.endpoints[0], b"x")
    (datagram,) = received(source)
    assert before <= datagram.time_ns <= time.time_ns()
    assert datagram.destination == source.endpoints[0]
    assert source.statistics.kernel_drops == 0
