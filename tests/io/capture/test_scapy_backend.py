"""Capture through scapy, on loopback; needs CAP_NET_RAW (``unshare -rn`` gives a user that)."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture import scapy_backend
from edoras_tools.io.capture.live import open_live
from edoras_tools.io.capture.scapy_backend import ScapySource


@pytest.fixture
def capture():
    sources = []

    def make(*arguments, **options):
        sources.append(ScapySource(*arguments, **options))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def received(source):
    source.stop()
    return [batch[row] for batch in source.batches() for row in range(len(batch))]


def test_datagrams_once_in_order_with_their_time(capture, pair):
    sender, port = pair
    wanted = [number.to_bytes(4, "big") * 10 for number in range(500)]
    said = []
    source = capture("lo", [port], ready=lambda: said.append(1))
    before = time.time_ns() // 1000 * 1000
    for payload in wanted:
        sender.send(payload)
    seen = received(source)
    after = time.time_ns() + 1000  # the kernel stamps the first ones when they are read, if it was busy
    assert [datagram.payload for datagram in seen] == wanted
    assert all(before <= datagram.time_ns <= after for datagram in seen)
    assert {str(datagram.destination) for datagram in seen} == {f"127.0.0.1:{port}"}
    assert {datagram.link_type for datagram in seen} == {1}
    assert source.statistics.datagrams == 500
    assert source.statistics.kernel_drops == 0
    assert said == [1]
    assert (source.info.name, source.info.kind, source.info.time_resolution_ns) == ("lo", "live", 1000)


def test_other_ports_are_left_out(capture, pair):
    sender, port = pair
    source = capture("lo", [port])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        sender.sendto(b"foreign", other.getsockname())
        sender.send(b"wanted")
    assert [datagram.payload for datagram in received(source)] == [b"wanted"]
    assert source.statistics.datagrams == 1


def test_no_ports_is_every_datagram(capture, pair):
    sender, _ = pair
    source = capture("lo")
    sender.send(b"wanted")
    assert b"wanted" in {datagram.payload for datagram in received(source)}


def test_snap_length(capture, pair):
    sender, port = pair
    source = capture("lo", [port], snap_length=60)
    sender.send(bytes(200))
    (datagram,) = received(source)
    assert (len(datagram.frame), datagram.original_length) == (60, 242)


def test_it_is_chosen_where_there_are_no_packet_sockets(capture, monkeypatch, pair):
    chosen = []
    monkeypatch.setattr("edoras_tools.io.capture.live.ScapySource", lambda *a, **k: chosen.append(a))
    monkeypatch.delattr("socket.AF_PACKET")
    open_live("lo", [1234])
    assert chosen == [("lo", [1234])]


def test_no_such_interface(capture):
    with pytest.raises(CaptureError, match=r"^nonesuch0: no such interface; there are .*lo"):
        capture("nonesuch0")


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (PermissionError(1, "Operation not permitted"), "needs CAP_NET_RAW"),
        (OSError(100, "Network is down"), "Network is down"),
        (ValueError("Interface 'lo' is odd"), "is odd"),
    ],
)
def test_what_scapy_raises_becomes_one_line(capture, monkeypatch, error, why):
    from scapy.config import conf

    def refuse(**_):
        raise error

    monkeypatch.setattr(conf, "L2listen", refuse)
    with pytest.raises(CaptureError, match=why) as caught:
        capture("lo", [1234])
    assert "\n" not in str(caught.value)


def test_frames_of_a_kind_that_nobody_reads(capture, monkeypatch, pair):
    sender, port = pair
    source = capture("lo", [port])
    monkeypatch.delitem(scapy_backend._LINK_TYPES, "Ether")
    sender.send(b"x")
    with pytest.raises(CaptureError, match="Ether frames cannot be read"):
        list(source.batches())


def test_the_filter_in_words():
    assert scapy_backend._expression([]) is None
    assert scapy_backend._expression([1234, 1235]).startswith("udp port 1234 or udp port 1235 or ")
    assert " or udp[8:4] = 1381257299 or " in scapy_backend._expression([1234], (), [b"RTPS"])


def test_what_begins_so_is_seen_on_any_port(capture, pair):
    sender, port = pair
    mark = f"R{port:x}"[:4].ljust(4, "_").encode()
    source = capture("lo", [1], begins=[mark])
    for body in (mark, b"RTP", b"other", mark + b"more"):
        sender.send(body)
    source.stop()
    found = [batch[row].payload for batch in source.batches() for row in range(len(batch))]
    assert found == [mark, mark + b"more"]


def test_the_licence_is_said_and_scapy_is_lazy():
    first = Path(scapy_backend.__file__).read_text(encoding="utf-8").splitlines()[0]
    assert first == "# SPDX-License-Identifier: GPL-2.0-only"
    probe = "import sys, edoras_tools.io.capture.scapy_backend; print('scapy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
