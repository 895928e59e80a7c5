"""Inputs with much of one thing: a function for each, which writes a file with ``count`` of it.

They are written byte by byte, or by the libraries of others, so that ours take no part in their cost.
"""

from __future__ import annotations

import gzip
import random
import sqlite3
import struct
from binascii import crc32
from contextlib import closing
from pathlib import Path

from mcap.writer import Writer

ROVER = Path(__file__).parents[2] / "samples/captures/a_rover.pcap"
BASE_S = 1_700_000_000
BASE_NS = BASE_S * 10**9
HERE, THERE = 0x0A000001, 0x0A000002
STEP_US = 100
FRAMES = "link: {ros__parameters: {frames: {a: {port: 5301, kind: tm, length: 64, fecf: false}}}}"


def ip(payload, *, source=THERE, protocol=17, identity=0, fragment=0):
    """Return a packet of IPv4 to ``HERE``."""
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(payload), identity, fragment, 64, protocol, 0)
    return head + struct.pack(">II", source, HERE) + payload


def udp(payload, port=1234, *, source=THERE, source_port=30000):
    """Return a packet of IPv4 with a datagram."""
    return ip(struct.pack(">HHHH", source_port, port, 8 + len(payload), 0) + payload, source=source)


def command(msg_id, count=0):
    """Return a command without arguments."""
    return struct.pack(">HHHBB", msg_id, 0xC000 | count & 0x3FFF, 1, 1, 0)


def telemetry(msg_id, count=0):
    """Return telemetry of four bytes."""
    return struct.pack(">HHHIHI", msg_id, 0xC000 | count & 0x3FFF, 9, 1_000_000, 0, 7)


def records(packets):
    """Yield the records of a pcap."""
    for place, packet in enumerate(packets):
        seconds, rest = divmod(place * STEP_US, 1_000_000)
        yield struct.pack("<IIII", BASE_S + seconds, rest, len(packet), len(packet)) + packet


def head(magic=0xA1B2C3D4, link_type=101):
    """Return the head of a pcap of IP packets."""
    return struct.pack("<IHHiIII", magic, 2, 4, 0, 0, 262144, link_type)


def write(path, packets):
    """Write a pcap."""
    path.write_bytes(head() + b"".join(records(packets)))


def pairs(path, count):
    """Commands that all have another MsgId or another source."""
    write(path, (udp(command(0x1800 + 7 * n % 2000, n), source=0x0A010000 + n) for n in range(count)))


def msg_ids(path, count):
    """Commands of 2,047 MsgIds, none of them known."""
    write(path, (udp(command(0x1800 + n % 2047, n)) for n in range(count)))


def telemetry_pairs(path, count):
    """Telemetry that all has another MsgId or another source."""
    write(path, (udp(telemetry(0x801 + n % 2000, n), 1235, source=0x0A010000 + n // 9) for n in range(count)))


def senders(path, count):
    """Telemetry that all comes from another address."""
    write(path, (udp(telemetry(0x801 + n % 2000, n), 1235, source=0x0A010000 + n) for n in range(count)))


def gaps(path, count):
    """Telemetry of one MsgId of which every second is missing."""
    write(path, (udp(telemetry(0x827, 2 * n), 1235) for n in range(count)))


def strangers(path, count):
    """Datagrams of no link, all with other endpoints."""
    packets = (udp(b"x", 10_000 + n % 50_000, source=0x0A010000 + n) for n in range(count))
    write(path, packets)


def fragments(path, count):
    """First fragments of datagrams whose rest never comes."""
    data = struct.pack(">HHHH", 30000, 1234, 2008, 0) + bytes(16)
    write(
        path,
        (
            ip(data, source=0x0A010000 + n // 60_000, identity=n % 60_000, fragment=0x2000)
            for n in range(count)
        ),
    )


def errors(path, count):
    """ICMP errors about as many closed ports."""
    quoted = (udp(command(0x1827, n), 1 + n % 65_000) for n in range(count))
    write(path, (ip(bytes([3, 3, 0, 0, 0, 0, 0, 0]) + item, protocol=1) for item in quoted))


def robots(path, count):
    """Datagrams to the robot's port from as many sources."""
    write(path, (udp(bytes(48), 8080, source=0x0A010000 + n) for n in range(count)))


def sbn(kind, payload, processor=3):
    """Return a message of SBN."""
    return struct.pack(">HBII", len(payload), kind, processor, 0x42) + payload


def peers(path, count):
    """Messages of as many peers of SBN."""
    write(path, (udp(sbn(3, telemetry(0x827, n), n), 2236) for n in range(count)))


def subscriptions(path, count):
    """Subscriptions of SBN, a message each, all of another MsgId."""
    revision = b"edoras".ljust(48, b"\0")
    wanted = (revision + struct.pack(">HIH", 1, 0x801 + n % 0x17FE, 0) for n in range(count))
    write(path, (udp(sbn(1, item), 2236) for item in wanted))


def tcp(sequence, data, port=2234, source_port=40000, flags=16):
    """Return a segment of TCP to ``HERE``."""
    fields = struct.pack(">HHIIBBHHH", source_port, port, sequence % (1 << 32), 1, 0x50, flags, 65535, 0, 0)
    return ip(fields + data, protocol=6)


def holes(path, count):
    """Segments of SBN over TCP in random order, of which every second is missing."""
    size = len(sbn(3, command(0x1827)))
    rest = list(range(2, 2 * count, 2))
    random.Random(1).shuffle(rest)
    order = [0, *rest]
    stream = (tcp(1000 + n * size, sbn(3, command(0x1827, n))) for n in order)
    write(path, (tcp(999, b"", flags=2), *stream))


def connections(path, count):
    """Connections of SBN over TCP, with one message each."""
    write(
        path,
        (
            item
            for n in range(count)
            for item in (
                tcp(999, b"", 2234, 1024 + n % 60_000, 2),
                tcp(1000, sbn(3, command(0x1827, n)), 2234, 1024 + n % 60_000),
            )
        ),
    )


def web_topics(path, count):
    """Messages of RACS2 in one connection, all on another topic."""
    asked = b"GET / HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\n"
    asked += b"Connection: Upgrade\r\nSec-WebSocket-Key: AA==\r\n\r\n"
    out, at = [tcp(99, b"", 8765, flags=2), tcp(100, asked, 8765)], 100 + len(asked)
    for n in range(count):
        body = b"/topic/%d".ljust(31, b"\0") % n
        body = body[:32].ljust(32, b"\0") + bytes(128)
        frame = struct.pack(">BBHI", 0x82, 0xFE, len(body), 0) + body
        out.append(tcp(at, frame, 8765))
        at += len(frame)
    write(path, out)


def fprime(path, count):
    """Events of F Prime, all of another number, which no dictionary has."""

    def frame(n):
        packet = struct.pack(">HIHBII", 2, n, 2, 0, 7, n)
        made = struct.pack(">II", 0xDEADBEEF, len(packet)) + packet
        return made + struct.pack(">I", crc32(made))

    write(path, (udp(frame(n), 50000) for n in range(count)))


def channels(path, count):
    """TM frames of eight virtual channels, each of which loses every second."""

    def frame(n):
        start = struct.pack(">HBBH", 42 << 4 | n % 8 << 1, n & 0xFF, n // 4 & 0xFF, 0x1800)
        packet = struct.pack(">HHH", 0x0827, 0xC000 | n & 0x3FFF, 51) + bytes(52)
        return start + packet

    write(path, (udp(frame(n), 5301) for n in range(count)))


def submessage(kind, body):
    """Return a submessage of RTPS."""
    return struct.pack("<BBH", kind, 5, len(body)) + body


def writers(path, count):
    """Samples of RTPS from as many writers, with gaps."""

    def message(n):
        body = struct.pack("<HHIIiI", 0, 16, 0, 0x03000000 | 1, 0, 2 * n + 1) + b"\0\1\0\0" + bytes(8)
        return b"RTPS\2\5\1\x10" + struct.pack(">QI", n, n) + submessage(0x15, body)

    write(path, (udp(message(n), 7411) for n in range(count)))


def sample_pieces(path, count):
    """Fragments of RTPS samples, none of which becomes whole."""

    def message(n):
        body = struct.pack("<HHIIiIIHHI", 0, 28, 0, 0x03120000, 0, n + 1, 1, 1, 100, 100_000) + bytes(100)
        return b"RTPS\2\5\1\x10" + struct.pack(">QI", 1, 1) + submessage(0x16, body)

    write(path, (udp(message(n), 7411) for n in range(count)))


def interfaces(path, count):
    """A pcapng with as many interfaces, and a packet on each."""

    def block(kind, body):
        body += bytes(-len(body) % 4)
        size = struct.pack("<I", 12 + len(body))
        return struct.pack("<I", kind) + size + body + size

    packet = udp(command(0x1827))
    out = [block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))]
    out += [block(1, struct.pack("<HHI", 101, 0, 0)) for _ in range(count)]
    for n in range(count):
        time = BASE_S * 10**6 + n
        fields = struct.pack("<IIIII", n, time >> 32, time & 0xFFFFFFFF, len(packet), len(packet))
        out.append(block(6, fields + packet))
    path.write_bytes(b"".join(out))


def packed(path, count):
    """A compressed pcap of equal packets."""
    path.write_bytes(gzip.compress(head() + b"".join(records(udp(command(0x1827, n)) for n in range(count)))))


def damaged(path, count):
    """A pcap of which every second record has a length that cannot be."""
    out = list(records(udp(command(0x1827, n)) for n in range(count)))
    out[1::2] = [item[:8] + b"\xff\xff\xff\x7f" + item[12:] for item in out[1::2]]
    path.write_bytes(head() + b"".join(out))


def _mcap(path, **options):
    writer = Writer(str(path), **options)
    writer.start("", "")
    return writer


def topics(path, count):
    """An MCAP with as many channels and schemas, and a message on each."""
    writer = _mcap(path)
    for n in range(count):
        schema = writer.register_schema(f"a/msg/T{n}", "ros2msg", b"uint8 x")
        channel = writer.register_channel(f"/t{n}", "cdr", schema)
        writer.add_message(channel, BASE_NS + n, b"\0\1\0\0\7", BASE_NS + n)
    writer.finish()


def tiny_messages(path, count):
    """An MCAP with one chunk of tiny messages."""
    writer = _mcap(path, chunk_size=1 << 30)
    schema = writer.register_schema("std_msgs/msg/UInt8", "ros2msg", b"uint8 data")
    channel = writer.register_channel("/t", "cdr", schema)
    for n in range(count):
        writer.add_message(channel, BASE_NS + n, b"\0\1\0\0\7", BASE_NS + n)
    writer.finish()


def chunks(path, count):
    """An MCAP with as many chunks, a message in each."""
    writer = _mcap(path, chunk_size=1)
    schema = writer.register_schema("std_msgs/msg/UInt8", "ros2msg", b"uint8 data")
    channel = writer.register_channel("/t", "cdr", schema)
    for n in range(count):
        writer.add_message(channel, BASE_NS + n, b"\0\1\0\0\7", BASE_NS + n)
    writer.finish()


def attachments(path, count):
    """An MCAP with as many attachments and pieces of metadata."""
    writer = _mcap(path)
    schema = writer.register_schema("std_msgs/msg/UInt8", "ros2msg", b"uint8 data")
    writer.add_message(writer.register_channel("/t", "cdr", schema), BASE_NS, b"\0\1\0\0\7", BASE_NS)
    for n in range(count):
        writer.add_attachment(BASE_NS, BASE_NS, f"a{n}", "text/plain", b"x")
        writer.add_metadata(f"m{n}", {"a": "b"})
    writer.finish()


def bag(path, count):
    """A file of rosbag2 with as many messages, each on a topic of its own."""
    with closing(sqlite3.connect(path)) as file, file:
        columns = "id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles"
        file.execute(f"CREATE TABLE topics({columns})")
        file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp INTEGER, data BLOB)")
        named = ((n, f"/t{n}", "std_msgs/msg/UInt8", "cdr", "") for n in range(count))
        file.executemany("INSERT INTO topics VALUES(?, ?, ?, ?, ?)", named)
        said = ((n, n, BASE_NS + n, b"\0\1\0\0\7") for n in range(count))
        file.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", said)


def captures(path, count):
    """A folder with a tenth as many captures of one datagram."""
    path.mkdir()
    for n in range(count // 10):
        write(path / f"{n:05}.pcap", [udp(command(0x1827, n))])


def times(path, count):
    """A real capture, again and again, of which every third time is any at all."""
    chosen, data, at, real = random.Random(2), ROVER.read_bytes(), 24, []
    while at < len(data):
        size = 16 + struct.unpack_from("<I", data, at + 8)[0]
        real.append(data[at + 4 : at + size])
        at += size
    out = [data[:24]]
    for n in range(count):
        second = chosen.getrandbits(32) if n % 3 == 0 else BASE_S + n // 50
        out += struct.pack("<I", second), real[n % len(real)]
    path.write_bytes(b"".join(out))


def unit(kind, number, body):
    """Return a datagram with a unit of CFDP that nobody acknowledges: 0 for file data, else a directive."""
    body = body if not kind else bytes([kind]) + body
    return udp(struct.pack(">BHBBIB", 0x24 | (not kind) << 4, len(body), 3, 1, number, 2) + body, 5111)


def _named(size, name=b"x"):
    return struct.pack(">BIB", 0, size, len(name)) + name + bytes([len(name)]) + name


def transactions(path, count):
    """As many files that CFDP sends, of four bytes each."""
    parts = ((7, _named(4, b"f")), (0, bytes(4) + b"abcd"), (4, b"\0abcd" + struct.pack(">I", 4)))
    write(path, (unit(kind, n, body) for n in range(count) for kind, body in parts))


def pieces(path, count):
    """One file of CFDP in as many pieces, in random order, of which every second one is missing."""
    order = list(range(0, 2 * count, 2))
    random.Random(3).shuffle(order)
    sent = [unit(0, 1, struct.pack(">I", 64 * n) + bytes(64)) for n in order]
    end = unit(4, 1, bytes(5) + struct.pack(">I", 128 * count))
    write(path, [unit(7, 1, _named(128 * count)), *sent, end])
