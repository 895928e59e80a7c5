from __future__ import annotations

import select
import socket

import numpy as np
import pytest
from waiting import HOST, PATIENCE_S, until

from edoras_tools.errors import CaptureError
from edoras_tools.io.net import transmit
from edoras_tools.io.net.transmit import Listener, SendStatistics, Transmitter
from edoras_tools.model import Endpoint


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        opened.bind((HOST, 0))
        opened.settimeout(PATIENCE_S)
        yield opened


@pytest.fixture
def sender(receiver):
    with Transmitter(Endpoint(HOST, receiver.getsockname()[1])) as opened:
        yield opened


@pytest.fixture
def closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind((HOST, 0))
        return opened.getsockname()[1]


def laid_out(payloads):
    length = np.array([len(item) for item in payloads], np.int32)
    return np.frombuffer(b"".join(payloads), np.uint8), np.cumsum(length, dtype=np.int64) - length, length


PAYLOADS = [bytes([index % 251]) * (index % 40) for index in range(300)]


@pytest.mark.parametrize("many", [True, False], ids=["sendmmsg", "one by one"])
def test_many_datagrams_arrive_in_order_and_whole(many, sender, receiver, monkeypatch):
    if not many:
        monkeypatch.setattr(sender, "_many", None)
    assert sender.send_many(*laid_out(PAYLOADS)) == 300
    assert [receiver.recv(100) for _ in PAYLOADS] == PAYLOADS
    assert sender.statistics == SendStatistics(300)


def test_a_part_of_a_buffer_is_sent(sender, receiver):
    data, offset, length = laid_out(PAYLOADS)
    assert sender.send_many(data, offset[7:9], length[7:9]) == 2
    assert [receiver.recv(100) for _ in range(2)] == PAYLOADS[7:9]


def test_more_than_fit_into_one_call(receiver, monkeypatch):
    monkeypatch.setattr(transmit, "_MANY", 50)
    payloads = [index.to_bytes(4, "big") for index in range(2 * 50 + 3)]
    with Transmitter(Endpoint(HOST, receiver.getsockname()[1])) as sender:
        assert sender.send_many(*laid_out(payloads)) == len(payloads)
    assert [receiver.recv(10) for _ in payloads] == payloads


@pytest.mark.parametrize("many", [True, False])
def test_what_is_too_long_for_udp_is_an_error_and_the_rest_goes_on(many, sender, receiver, monkeypatch):
    if not many:
        monkeypatch.setattr(sender, "_many", None)
    assert sender.send_many(*laid_out([b"a", bytes(65_508), b"b"])) == 2
    assert [receiver.recv(10) for _ in range(2)] == [b"a", b"b"]
    assert sender.statistics.errors == {"Message too long": 1}


@pytest.mark.parametrize("many", [True, False])
def test_refusals_are_noticed(many, closed_port):
    with Transmitter(Endpoint(HOST, closed_port)) as sender:
        if many:
            sender.send_many(*laid_out([b"a"] * 10))
        else:
            assert [sender.send(b"a") for _ in range(10)] == [True] * 10
        assert sender.receive() == []
        assert sender.statistics.sent == 10
        assert 1 <= sender.statistics.refused <= 10
        assert sender.statistics.errors == {}


@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, HOST), (socket.AF_INET6, "::1")])
def test_what_is_rehearsed_is_neither_sent_nor_counted(family, host):
    with socket.socket(family, socket.SOCK_DGRAM) as receiver:
        receiver.bind((host, 0))
        receiver.settimeout(PATIENCE_S)
        with Transmitter(Endpoint(host, receiver.getsockname()[1])) as sender:
            for turn in range(5):
                for _ in range(20):
                    sender.rehearse(b"rehearsed")
                assert sender.send(bytes([turn]))
                assert receiver.recv(10) == bytes([turn])
            assert sender.statistics == SendStatistics(5)
            receiver.setblocking(False)
            with pytest.raises(BlockingIOError):
                receiver.recv(10)


def test_a_rehearsal_takes_no_refusal_away(closed_port):
    with Transmitter(Endpoint(HOST, closed_port)) as sender:
        sender.send(b"a")
        refused = select.poll()
        refused.register(sender.fileno(), 0)
        assert refused.poll(PATIENCE_S * 1000)  # the answer is there
        for _ in range(20):
            sender.rehearse(b"a")
        assert sender.receive() == []
        assert sender.statistics.refused == 1


@pytest.mark.parametrize("flag", [0, socket.MSG_OOB])
def test_where_the_system_does_not_know_rehearsals_there_are_none(flag, receiver, monkeypatch):
    """Neither where it would send them, nor where it refuses the flag."""
    monkeypatch.setattr(transmit, "_MSG_PROBE", flag)
    until(lambda: not transmit._probes())  # a busy system may deliver later
    monkeypatch.setattr(transmit, "_probes", lambda: False)
    with Transmitter(Endpoint(HOST, receiver.getsockname()[1])) as sender:
        sender.rehearse(b"rehearsed")
        sender.send(b"sent")
        assert receiver.recv(10) == b"sent"


def test_answers_are_received(sender, receiver):
    receiver.connect((sender.local.address, sender.local.port))
    for payload in (b"one", b"", b"two"):
        receiver.send(payload)
    assert sender.receive(2) == [(b"one", sender.target), (b"", sender.target)]
    assert sender.receive() == [(b"two", sender.target)]
    assert sender.receive() == []


def test_it_sends_from_where_it_is_told_to(receiver, closed_port):
    target = Endpoint(HOST, receiver.getsockname()[1])
    with Transmitter(target, Endpoint(HOST, closed_port)) as sender:
        sender.send(b"x")
        assert receiver.recvfrom(10)[1] == (HOST, closed_port)


def test_a_listener_hears_everybody(sender):
    ear = Listener(Endpoint(HOST, 0))
    with Transmitter(ear.local) as one, Transmitter(ear.local) as other:
        one.send(b"1")
        other.send(b"2")
        assert ear.receive() == [(b"1", one.local), (b"2", other.local)]
    ear.close()


@pytest.mark.parametrize(
    ("kind", "endpoint", "words"),
    [
        (Transmitter, Endpoint("no.such.host.invalid", 1), "neither an address nor the name of a known host"),
        (Transmitter, Endpoint(HOST, 70000), "0 to 65535"),
        (Listener, Endpoint("192.0.2.1", 0), "cannot be bound: not an address of this machine"),
        (Listener, Endpoint(HOST, -1), "0 to 65535"),
    ],
)
def test_an_endpoint_that_is_none_is_one_clear_line(kind, endpoint, words):
    with pytest.raises(CaptureError, match=words):
        kind(endpoint)


def test_a_port_in_use_says_what_to_do(receiver):
    taken = Endpoint(HOST, receiver.getsockname()[1])
    with pytest.raises(CaptureError, match=r"another program has port.*--listen"):
        Listener(taken)
    with pytest.raises(CaptureError, match="another program has port"):
        Transmitter(taken, taken)
