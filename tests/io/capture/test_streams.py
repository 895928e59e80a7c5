"""TCP streams of real sockets, captured by the tool itself on loopback; tshark puts them together too.

It needs CAP_NET_RAW (``unshare -rn`` gives a user that), as all live captures.
"""

from __future__ import annotations

import asyncio
import json
import random
import shutil
import socket
import struct
import subprocess
import threading

import pytest
import websockets
from racs2_peer import to_cfs, to_ros
from streams import packet, sbn_message, sbn_messages
from waiting import PATIENCE_S

from edoras_tools.addons.racs2.link import RACS2
from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.io.capture.live import open_live
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding, concatenate


class SbnPeer:
    """One end of SBN over TCP as the public module is: messages end to end, each read by its size.

    The peer with the smaller ProcessorID connects.
    """

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.connection.settimeout(PATIENCE_S)
        self.received: list[bytes] = []

    def read(self, count: int) -> None:
        """Receive so many messages."""
        for _ in range(count):
            head = self._exactly(11)
            (size,) = struct.unpack_from(">h", head)
            self.received.append(head + self._exactly(size))

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += self.connection.recv(count - len(data))
        return data


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def captured(link, port, talk):
    """Capture what ``talk`` does on loopback; return the rows, each with its link and its batch."""
    context = Context(options=Options(ports=((link, port),)))
    source = open_live("lo", [port], streams=[port])
    source.follow(context.framings)
    found = []

    def work():
        talk()
        source.stop()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        decoder = ColumnDecoder(context)
        for batch in source.batches():
            columns = decoder.decode(batch)
            found += [(batch[row], int(columns.link[row]), batch) for row in range(len(batch))]
    finally:
        thread.join()
        source.close()
    return found


def sbn_over(port, there, back):
    """Let two peers send messages to each other, in writes of any size, and read them."""
    random.seed(5)
    server = socket.create_server(("127.0.0.1", port))
    client = socket.create_connection(("127.0.0.1", port))
    accepted, _ = server.accept()
    server.close()
    ends = SbnPeer(client), SbnPeer(accepted)
    for end, messages in zip(ends, (there, back), strict=True):
        stream = b"".join(messages)
        while stream:
            size = random.choice([1, 7, 11, 40, 700, 20_000])
            end.connection.sendall(stream[:size])
            stream = stream[size:]
    ends[1].read(len(there))
    ends[0].read(len(back))
    for end in ends:
        end.connection.close()
    return ends


def test_sbn_peers_over_tcp(port):
    there = [*sbn_messages(200), sbn_message(3, packet(0x1827, 1, bytes(32_000)))]
    back = [sbn_message(3, packet(0x0827, number, bytes(90)), processor=2) for number in range(100)]
    talked = []
    found = captured(SBN, port, lambda: talked.append(sbn_over(port, there, back)))
    sent = [item.payload for item, link, _ in found if link == SBN and item.destination.port == port]
    answered = [item.payload for item, link, _ in found if link == SBN and item.source.port == port]
    assert sent == there == talked[0][1].received
    assert answered == back == talked[0][0].received
    assert not any(item.findings & ~Finding.FRAGMENT for item, _, _ in found)


async def racs2_over(port, said, *, deflate):
    """Let `websockets` be both bridges; return what each side received."""
    received = [], []

    async def ros(connection):
        async for message in connection:
            received[1].append(message)
        # The client has closed.

    async with websockets.serve(ros, "127.0.0.1", port, compression=deflate) as server:
        async with websockets.connect(f"ws://127.0.0.1:{port}/", compression=deflate) as cfs:
            for number, (to_topic, to_app) in enumerate(said):
                await cfs.send(to_topic)
                for connection in list(server.connections):
                    await connection.send(to_app)
                received[0].append(await cfs.recv())
                if number % 7 == 0:
                    await (await cfs.ping())
        server.close()
    return received


@pytest.mark.parametrize("deflate", [None, "deflate"])
def test_racs2_bridges(port, deflate):
    said = [
        (to_ros(f"/topic_{number}", bytes([0x20, number])), to_cfs(0x1894 + number, b"x" * number))
        for number in range(60)
    ]
    heard = []
    found = captured(RACS2, port, lambda: heard.append(asyncio.run(racs2_over(port, said, deflate=deflate))))
    to_topics = [item.payload for item, link, _ in found if link == RACS2 and item.destination.port == port]
    to_apps = [item.payload for item, link, _ in found if link == RACS2 and item.source.port == port]
    assert to_topics == [item for item, _ in said] == heard[0][1]
    assert to_apps == [item for _, item in said] == heard[0][0]


@pytest.mark.quick("deflate")
@pytest.mark.skipif(not shutil.which("tshark"), reason="tshark is not installed")
@pytest.mark.parametrize("deflate", [None, "deflate"])
def test_tshark_reads_the_same_from_what_is_written(port, deflate, tmp_path):
    said = [(to_ros("/topic", bytes([number])), to_cfs(0x1894, b"y" * number)) for number in range(30)]
    found = captured(RACS2, port, lambda: asyncio.run(racs2_over(port, said, deflate=deflate)))
    target = tmp_path / "racs2.pcap"
    sink = PcapSink(target, nanosecond=True)
    batches = list({id(batch): batch for _, _, batch in found}.values())
    sink.write(concatenate(batches), None)
    sink.close(None)
    command = ["tshark", "-n", "-r", str(target), "-T", "json", "-x", "-Y", "websocket.opcode == 2"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=120)
    seen = []
    for item in json.loads(done.stdout):
        layers = item["_source"]["layers"]
        raw = layers["data_raw"] if "data_raw" in layers else layers["websocket"]["websocket.payload_raw"]
        seen.append(bytes.fromhex(raw[0]))
    assert seen == [item.payload for item, link, _ in found if link == RACS2]
    with_us = open_file(target)
    with_us.follow(Context(options=Options(ports=((RACS2, port),))).framings)
    again = [batch[row] for batch in with_us.batches() for row in range(len(batch))]
    with_us.close()
    assert [item.payload for item in again] == [item.payload for item, _, _ in found]


@pytest.mark.skipif(not shutil.which("tshark"), reason="tshark is not installed")
def test_tshark_follows_the_same_stream(port, tmp_path):
    there = sbn_messages(300)
    found = captured(SBN, port, lambda: sbn_over(port, there, [sbn_message(4, b"\x0b")]))
    target = tmp_path / "sbn.pcap"
    sink = PcapSink(target, nanosecond=True)
    sink.write(concatenate(list({id(batch): batch for _, _, batch in found}.values())), None)
    sink.close(None)
    done = subprocess.run(
        ["tshark", "-n", "-r", str(target), "-q", "-z", "follow,tcp,raw,0"],
        capture_output=True,
        check=True,
        timeout=120,
        text=True,
    )
    lines = [
        line
        for line in done.stdout.splitlines()
        if line.strip() and set(line.strip()) <= set("0123456789abcdef")
    ]
    assert bytes.fromhex("".join(lines)) == b"".join(there) + sbn_message(4, b"\x0b")
