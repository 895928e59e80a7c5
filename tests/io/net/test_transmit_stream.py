"""SBN over TCP to a listener that behaves as SBN's TCP module: it answers the first message, and reads on."""

import gzip
import json
import socket
import struct
import time
from threading import Thread

import numpy as np
import pytest
import warm
from places import SAMPLES
from streams import Segment, packet, sbn_message, write_segments

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.transmit_stream import StreamTransmitter
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint
from edoras_tools.wire import sbn

HOST = "127.0.0.1"
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
