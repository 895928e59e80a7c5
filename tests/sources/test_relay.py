"""Both arenas do the same: what is received is what was sent, to the byte, and in order."""

import socket

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint
from edoras_tools.sources import relay
from edoras_tools.sources.relay import ROOMS, SPARE, PlainArena, VectorArena
from edoras_tools.sources.sockaddr import address_of, host_of, resolve

LOOPBACK = Endpoint("127.0.0.1", 0)
ARENAS = [VectorArena, PlainArena]


@pytest.fixture(scope="module", params=ARENAS)
def arena(request):
    try:
        return request.param()
    except AttributeError:
        pytest.skip("the C library lacks recvmmsg")


@pytest.fixture
def ends():
    """A bound port, and a socket that is connected to it."""
    port, sender = relay.open_port(LOOPBACK), relay.open_socket(socket.AF_INET)
    sender.connect(port.getsockname())
    yield port, sender
    port.close()
    sender.close()


def payloads(arena, count):
    return [relay.payload_of(arena, row) for row in range(count)]


def drain(opened):
    found = []
    while True:
        try:
            found.append(opened.recv(65536))
        except BlockingIOError:
            return found


@settings(max_examples=30)
@given(
    datagrams=st.lists(st.binary(max_size=200), max_size=20),
    large=st.integers(0, 65507).map(bytes),  # two of them are more than some systems' buffers hold
    place=st.integers(0, 20),
)
def test_what_comes_in_goes_out(arena, datagrams, large, place):
    datagrams.insert(place, large)
    port, other = relay.open_port(LOOPBACK), relay.open_port(LOOPBACK)
    with port, other, relay.open_socket(socket.AF_INET) as sender, relay.open_socket(socket.AF_INET) as on:
        sender.connect(port.getsockname())
        on.connect(other.getsockname())
        for datagram in datagrams:
            sender.send(datagram)
        count = arena.receive(port)
        assert payloads(arena, count) == datagrams
        assert arena.send(on, count, None).done == count
        assert drain(other) == datagrams


def test_more_than_there_are_rooms_for_waits_its_turn(arena, ends):
    port, sender = ends
    sent = [number.to_bytes(2, "big") for number in range(ROOMS + 5)]
    for datagram in sent:
        sender.send(datagram)
    first = payloads(arena, arena.receive(port))
    assert first + payloads(arena, arena.receive(port)) == sent
    assert len(first) == ROOMS
    assert arena.receive(port) == 0


def test_senders_and_times_are_told(arena, ends):
    port, sender = ends
    sender.send(b"a")
    with relay.open_socket(socket.AF_INET) as other:
        other.sendto(b"b", port.getsockname())
    assert arena.receive(port) == 2
    first, second = (host_of(item.tobytes()) for item in arena.senders(2))
    assert first.host == sender.getsockname()
    assert second.host != first.host
    assert second.endpoint.address == "127.0.0.1"
    times = arena.times(2)
    assert 1_700_000_000 * 10**9 < times[0] <= times[1]


def test_rows_go_out_in_the_order_asked_for_and_to_whom(arena, ends):
    port, sender = ends
    for datagram in (b"a", b"bb", b"ccc"):
        sender.send(datagram)
    assert arena.receive(port) == 3
    relay.stage(arena, ROOMS + SPARE - 1, b"spare")
    back = address_of(socket.AF_INET, sender.getsockname())
    rows = np.array([2, 0, ROOMS + SPARE - 1, 0])
    assert arena.send(port, rows, back).done == 4
    assert drain(sender) == [b"ccc", b"a", b"spare", b"a"]
    assert arena.send(port, rows, back, 2).done == 2
    assert arena.send(port, 3, back, 1).done == 2
    assert drain(sender) == [b"spare", b"a", b"bb", b"ccc"]


def test_a_refusal_is_news_and_loses_nothing_that_comes_after(arena, ends):
    port, sender = ends
    nobody = port.getsockname()
    port.close()
    relay.stage(arena, 0, b"x")
    assert arena.send(sender, 1, None).refused == 0  # the answer comes later
    with relay.open_port(Endpoint(*nobody)) as again:
        sent = arena.send(sender, 1, None)
        assert (sent.done, sent.refused) == (1, 1)
        assert drain(again) == [b"x"]
    arena.send(sender, 1, None)
    assert arena.receive(sender) == -1
    assert arena.receive(sender) == 0


def test_what_the_system_will_not_send_is_told_and_the_rest_goes(arena, ends):
    port, sender = ends
    for row, payload in enumerate((b"a", bytes(65508), b"c")):
        relay.stage(arena, row, payload)
    sent = arena.send(sender, 3, None)
    assert (sent.done, sent.failed, sent.reason) == (3, 1, "Message too long")
    assert drain(port) == [b"a", b"c"]


def test_ipv6_addresses_go_both_ways(arena):
    try:
        port = relay.open_port(Endpoint("::1", 0))
    except CaptureError:
        pytest.skip("no IPv6 here")
    with port, relay.open_socket(socket.AF_INET6) as sender:
        sender.connect(port.getsockname())
        sender.send(b"six")
        assert arena.receive(port) == 1
        back = host_of(arena.senders(1)[0].tobytes())
        assert back == address_of(socket.AF_INET6, sender.getsockname())
        assert arena.send(port, 1, back).done == 1
        assert drain(sender) == [b"six"]


def test_a_port_in_use_and_an_unknown_host_are_told(ends):
    port, _ = ends
    with pytest.raises(CaptureError, match=r"another program has port \d+"):
        relay.open_port(Endpoint(*port.getsockname()))
    with pytest.raises(CaptureError, match=r"--target no\.such\.host\.invalid:1: no such host"):
        resolve(Endpoint("no.such.host.invalid", 1), "--target")
