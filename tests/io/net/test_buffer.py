"""Both buffers do the same: what is received is what was sent, to the byte, and in order."""

import socket

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer, VectorBuffer, usable
from edoras_tools.io.net.sockets import address_of, host_of, open_bound, open_socket, resolve
from edoras_tools.model import Endpoint

LOOPBACK = Endpoint("127.0.0.1", 0)


@pytest.fixture(scope="module", params=[VectorBuffer, DatagramBuffer])
def buffer(request):
    if request.param is VectorBuffer and not usable():
        pytest.skip("this system has no recvmmsg")
    return request.param()


@pytest.fixture
def ends():
    """A bound port, and a socket that is connected to it."""
    port, sender = open_bound(LOOPBACK), open_socket(socket.AF_INET)
    sender.connect(port.getsockname())
    yield port, sender
    port.close()
    sender.close()


def payloads(buffer, count):
    return [buffer.payload(row) for row in range(count)]


def drain(opened):
    found = []
    while True:
        try:
            found.append(opened.recv(65536))
        except BlockingIOError:
            return found


@settings(max_examples=examples(30, 4))
@given(
    datagrams=st.lists(st.binary(max_size=200), max_size=20),
    large=st.integers(0, 65507).map(bytes),  # two of them are more than some systems' buffers hold
    place=st.integers(0, 20),
)
def test_what_comes_in_goes_out(buffer, datagrams, large, place):
    datagrams.insert(place, large)
    port, other = open_bound(LOOPBACK), open_bound(LOOPBACK)
    with port, other, open_socket(socket.AF_INET) as sender, open_socket(socket.AF_INET) as on:
        sender.connect(port.getsockname())
        on.connect(other.getsockname())
        for datagram in datagrams:
            sender.send(datagram)
        count = buffer.receive(port)
        assert payloads(buffer, count) == datagrams
        assert buffer.send(on, count, None).sent == count
        assert drain(other) == datagrams


def test_more_than_there_are_slots_for_waits_its_turn(buffer, ends):
    port, sender = ends
    sent = [number.to_bytes(2, "big") for number in range(SLOTS + 5)]
    for datagram in sent:
        sender.send(datagram)
    first = payloads(buffer, buffer.receive(port))
    assert first + payloads(buffer, buffer.receive(port)) == sent
    assert len(first) == SLOTS
    assert buffer.receive(port) == 0


def test_senders_and_times_are_told(buffer, ends):
    port, sender = ends
    sender.send(b"a")
    with open_socket(socket.AF_INET) as other:
        other.sendto(b"b", port.getsockname())
    assert buffer.receive(port) == 2
    first, second = (host_of(item.tobytes()) for item in buffer.senders(2))
    assert first.host == sender.getsockname()
    assert second.host != first.host
    assert second.endpoint.address == "127.0.0.1"
    times = buffer.times(2)
    assert 1_700_000_000 * 10**9 < times[0] <= times[1]


def test_rows_go_out_in_the_order_asked_for_and_to_whom(buffer, ends):
    port, sender = ends
    for datagram in (b"a", b"bb", b"ccc"):
        sender.send(datagram)
    assert buffer.receive(port) == 3
    buffer.put(SLOTS + SPARE - 1, b"spare")
    back = address_of(socket.AF_INET, sender.getsockname())
    rows = np.array([2, 0, SLOTS + SPARE - 1, 0])
    assert buffer.send(port, rows, back).sent == 4
    assert drain(sender) == [b"ccc", b"a", b"spare", b"a"]
    assert buffer.send(port, 3, back).sent == 3
    assert drain(sender) == [b"a", b"bb", b"ccc"]


def test_a_refusal_is_news_and_loses_nothing_that_comes_after(buffer, ends):
    port, sender = ends
    nobody = port.getsockname()
    port.close()
    buffer.put(0, b"x")
    assert buffer.send(sender, 1, None).refused == 0  # the answer comes later
    with open_bound(Endpoint(*nobody)) as again:
        sent = buffer.send(sender, 1, None)
        assert (sent.sent, sent.refused) == (1, 1)
        assert drain(again) == [b"x"]
    buffer.send(sender, 1, None)
    assert buffer.receive(sender) == -1
    assert buffer.receive(sender) == 0


def test_what_the_system_will_not_send_is_told_and_the_rest_goes(buffer, ends):
    port, sender = ends
    for row, payload in enumerate((b"a", bytes(65508), b"c")):
        buffer.put(row, payload)
    sent = buffer.send(sender, 3, None)
    assert (sent.sent, sent.errors) == (3, {"Message too long": 1})
    assert drain(port) == [b"a", b"c"]


def test_ipv6_addresses_go_both_ways(buffer):
    try:
        port = open_bound(Endpoint("::1", 0))
    except CaptureError:
        pytest.skip("no IPv6 here")
    with port, open_socket(socket.AF_INET6) as sender:
        sender.connect(port.getsockname())
        sender.send(b"six")
        assert buffer.receive(port) == 1
        back = host_of(buffer.senders(1)[0].tobytes())
        assert back == address_of(socket.AF_INET6, sender.getsockname())
        assert buffer.send(port, 1, back).sent == 1
        assert drain(sender) == [b"six"]


def test_a_port_in_use_and_an_unknown_host_are_told(ends):
    port, _ = ends
    with pytest.raises(CaptureError, match=r"another program has port \d+"):
        open_bound(Endpoint(*port.getsockname()))
    with pytest.raises(
        CaptureError, match=r"--target no\.such\.host\.invalid:1: .* nor the name of a known host"
    ):
        resolve(Endpoint("no.such.host.invalid", 1), "--target no.such.host.invalid:1")


@pytest.mark.parametrize(
    ("local", "own"), [(Endpoint("0.0.0.0", 0), "127.1.2.3"), (Endpoint("::", 0), "::1")]
)
def test_where_datagrams_were_sent_to_is_told(buffer, local, own):
    with open_bound(local, destinations=True) as port:
        family = port.family
        with open_socket(family) as sender:
            for datagram in (b"a", b"b"):
                sender.sendto(datagram, (own, port.getsockname()[1]))
        assert buffer.receive(port) == 2
        found = buffer.destinations(2, 4 if family == socket.AF_INET else 6)
        assert [socket.inet_ntop(family, item.tobytes()) for item in found] == [own, own]
