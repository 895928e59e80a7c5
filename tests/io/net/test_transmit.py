from __future__ import annotations

import gc
import gzip
import itertools
import json
import os
import select
import socket
import struct
import time
from threading import Thread

import numpy as np
import pytest
import warm
from places import SAMPLES
from streams import Segment, packet, sbn_message, write_segments
from waiting import HOST, PATIENCE_S, until

from edoras_tools.errors import CaptureError
from edoras_tools.io.net import transmit
from edoras_tools.io.net.transmit import (
    Listener,
    SendStatistics,
    StreamTransmitter,
    Transmitter,
    UdpWire,
    precise_timing,
)
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.wire import sbn


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


IDENT = sbn.IDENT.encode().ljust(sbn.IDENT_BYTES, b"\0")
APP, PROTO, SUB = 3, 4, 1
SENT = [packet(0x1827, number, bytes([number]) * (1 + 40 * number)) for number in range(12)]


class CfsSide:
    """A listener for one connection: it notes (time, type, payload) of each message.

    Its answer to the first message: PROTO and the subscriptions, cut at an awkward place.
    """

    def __init__(self, answers=True, hang_up_after=None):
        self.listener = socket.create_server((HOST, 0))
        self.port = self.listener.getsockname()[1]
        self.got, self._answers, self._limit = [], answers, hang_up_after
        self.thread = Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        connection, _ = self.listener.accept()
        rest = b""
        with connection:
            while data := connection.recv(65536):
                rest += data
                while len(rest) >= 11 and len(rest) >= 11 + int.from_bytes(rest[:2], "big"):
                    size, kind, _, _ = struct.unpack(">hBII", rest[:11])
                    self.got.append((time.monotonic(), kind, rest[11 : 11 + size]))
                    rest = rest[11 + size :]
                    if len(self.got) == 1 and self._answers:
                        wanted = struct.pack(">HIBB", 1, 0x1827, 0, 0)
                        answer = sbn_message(PROTO, b"\x0b", 1) + sbn_message(SUB, IDENT + wanted, 1)
                        answer = self._answers if isinstance(self._answers, bytes) else answer
                        connection.sendall(answer[:17])
                        time.sleep(0.02)
                        connection.sendall(answer[17:])
                    if self._limit is not None and len(self.got) >= self._limit:
                        return

    def close(self):
        self.listener.close()
        self.thread.join(60)


@pytest.fixture
def capture(tmp_path):
    """SBN over TCP: PROTO and SUB of the peer, then its packets 50 ms apart, cut into other segments."""
    said = [sbn_message(PROTO, b"\x0b"), *(sbn_message(APP, item) for item in SENT)]
    segments, at = [Segment(999, flags=2)], 1000
    for number, item in enumerate(said):
        when = 1_700_000_000_000_000_000 + number * 50_000_000
        for part in (item[:7], item[7:]):
            segments.append(Segment(at, part, time_ns=when))
            at += len(part)
    write_segments(tmp_path / "x.pcap", segments)
    return tmp_path / "x.pcap"


def replayed(capture, port, *more):
    words = ["replay", capture, "--to", "sbn", "--json"]
    words += ["--target", f"{HOST}:{port}", "--linger", "50ms", *more]
    return warm.run(*words, text=True)


def test_the_packets_leave_at_their_times_in_a_session(capture):
    cfs = CfsSide()
    done = replayed(capture, cfs.port, "--tcp")
    cfs.close()
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["sent"] == len(SENT)
    kinds = [kind for _, kind, _ in cfs.got]
    assert set(kinds[: kinds.index(APP)]) == {PROTO}, "the recording subscribes to nothing"
    assert 0xA2 not in kinds, "TCP has no DISCONNECT"
    packets = [(when, payload) for when, kind, payload in cfs.got if kind == APP]
    assert [payload for _, payload in packets] == SENT
    assert packets[-1][0] - packets[0][0] > 0.9 * 0.05 * (len(SENT) - 1)


@pytest.mark.long
def test_as_captured_and_twice_as_fast(capture):
    cfs = CfsSide(answers=False)
    done = replayed(capture, cfs.port, "--tcp", "--role", "captured", "--speed", "20")
    cfs.close()
    assert done.returncode == 0, done.stderr
    assert [(kind, payload) for _, kind, payload in cfs.got] == [
        (PROTO, b"\x0b"),
        *((APP, item) for item in SENT),
    ]


def test_a_target_that_does_not_answer_may_have_no_such_peer_and_crash(capture):
    cfs = CfsSide(answers=False)
    done = replayed(capture, cfs.port, "--tcp", "--as", "66:9", "--timeout", "50ms")
    cfs.close()
    assert done.returncode == 1
    (line,) = (text for text in done.stderr.splitlines() if "no SBN peer answered" in text)
    assert "has no 66:9: set --as SC:CPU as in the table. Look whether cFS still runs" in line
    assert "--listen" not in line


def test_a_target_that_hangs_up_or_is_not_there_is_one_line(capture):
    cfs = CfsSide(hang_up_after=6)
    done = replayed(capture, cfs.port, "--tcp")
    cfs.close()
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert f"TCP {HOST}:{cfs.port}: " in done.stderr
    done = replayed(capture, cfs.port, "--tcp")
    told = json.loads(done.stderr)["error"]
    assert (done.returncode, told["message"], told["hint"]) == (
        1,
        f"TCP {HOST}:{cfs.port}: refuses the connection: no program listens there",
        "start it, or name its address with --target",
    )


@pytest.mark.quick("more0*")
@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--tcp", "--role", "bridge"], "no --role bridge"),
        (["--tcp", "--listen", "2236"], "--listen is for datagrams"),
        (["--tcp", "-o", "x.mcap"], "-o records datagrams"),
    ],
)
def test_what_does_not_go_together_is_refused(capture, more, said, tmp_path):
    more = [str(tmp_path / item) if item.endswith(".mcap") else item for item in more]
    done = replayed(capture, 9, *more)
    assert (done.returncode, len(done.stderr.splitlines())) == (2 if done.returncode == 2 else 1, 1)
    assert said in done.stderr


def test_what_came_over_tcp_may_be_sent_as_datagrams_and_is_told(capture):
    plan = json.loads(replayed(capture, 9, "--dry-run").stdout)
    assert plan["datagrams"] == len(SENT)
    assert plan["notes"] == ["12 of them came over TCP, and are sent as datagrams; --tcp sends them over TCP"]


def forever(receive):
    while True:
        yield from receive()


def test_messages_come_back_however_they_are_cut():
    with socket.create_server((HOST, 0)) as listener:
        port = listener.getsockname()[1]
        with StreamTransmitter(Endpoint(HOST, port), SBN.framing) as transmitter:
            connection, _ = listener.accept()
            with connection:
                said = [sbn_message(APP, item) for item in SENT]
                found = []
                for byte in b"".join(said[:3]):
                    connection.send(bytes([byte]))
                    found += transmitter.receive()
                connection.sendall(b"".join(said[3:]))
                connection.shutdown(socket.SHUT_WR)
                data = np.frombuffer(b"onetwo", np.uint8)
                assert transmitter.send_many(data, np.array([0, 3]), np.array([3, 3], np.int32)) == 2
                with pytest.raises(CaptureError, match="closed the connection after 2 messages"):
                    found.extend(forever(transmitter.receive))
                assert [payload for payload, _ in found] == said
                assert connection.recv(100) == b"onetwo"
            assert transmitter.statistics.sent == 2


def test_another_protocol_is_one_error():
    with socket.create_server((HOST, 0)) as listener:
        endpoint = Endpoint(HOST, listener.getsockname()[1])
        with StreamTransmitter(endpoint, SBN.framing) as transmitter:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(b"\xff" * 40)
                with pytest.raises(CaptureError, match="sends another protocol"):
                    list(forever(transmitter.receive))


def recorded_streams():
    """Return what each end of the run with a real cFS sent, by (source port, destination port)."""
    from scapy.layers.inet import TCP
    from scapy.utils import PcapReader

    by_ends = {}
    with gzip.open(SAMPLES / "cfs_files/sbn_tcp.pcap.gz") as file, PcapReader(file) as reader:
        for frame in reader:
            if TCP in frame and (
                data := bytes(frame[TCP].payload)[: frame["IP"].len - 20 - 4 * frame[TCP].dataofs]
            ):
                by_ends.setdefault((frame[TCP].sport, frame[TCP].dport), {})[frame[TCP].seq] = data
    return {ends: b"".join(data for _, data in sorted(parts.items())) for ends, parts in by_ends.items()}


def test_what_a_real_cfs_answers_is_understood_and_it_gets_the_same_packets_again():
    """The listener says what cFS said in the recorded run; packets come in the recorded order, unchanged."""
    streams = recorded_streams()
    ours, theirs = streams[60784, 2234], streams[2234, 60784]
    cfs = CfsSide(answers=theirs)
    done = replayed(SAMPLES / "cfs_files/sbn_tcp.pcap.gz", cfs.port, "--tcp", "--speed", "20")
    cfs.close()
    assert done.returncode == 0, done.stderr
    packets, at = [], 0
    while at < len(ours):
        size, kind = struct.unpack(">hB", ours[at : at + 3])
        packets += [ours[at + 11 : at + 11 + size]] * (kind == APP)
        at += 11 + size
    assert [payload for _, kind, payload in cfs.got if kind == APP] == packets
    assert len(packets) == 60


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
