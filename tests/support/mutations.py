"""Changes of a capture that must not move a proven loss above the truth: seeded, on frames of pcap files."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import NamedTuple

import zstandard

SECOND = 10**9


class Frame(NamedTuple):
    """One record of a pcap file: capture time in ns, bytes, and the length on the wire."""

    time_ns: int
    data: bytes
    length: int


Change = Callable[[list[Frame], random.Random], list[Frame]]


def frames(path) -> list[Frame]:
    """Return the records of a little-endian pcap file in microseconds, compressed with zstd."""
    data, at, out = zstandard.decompress(path.read_bytes()), 24, []
    assert data[:4] == b"\xd4\xc3\xb2\xa1"
    while at + 16 <= len(data):
        seconds, micros, kept, length = struct.unpack_from("<IIII", data, at)
        out.append(Frame(seconds * SECOND + micros * 1000, data[at + 16 : at + 16 + kept], length))
        at += 16 + kept
    return out


def write(path, items: list[Frame]):
    """Write records as a pcap file of Ethernet frames in ns; return the path."""
    out = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 1)]
    for item in items:
        head = struct.pack("<IIII", *divmod(item.time_ns, SECOND), len(item.data), item.length)
        out += head, item.data
    path.write_bytes(b"".join(out))
    return path


def removed(share: float) -> Change:
    """Leave out a share of the frames at random."""
    return lambda items, chance: [item for item in items if chance.random() >= share]


def without_runs(number: int, length: int = 12) -> Change:
    """Leave out runs of frames anywhere, as a capture does whose buffer is full."""

    def change(items, chance):
        gone: set[int] = set()
        for _ in range(number):
            first = chance.randrange(max(1, len(items) - length))
            gone.update(range(first, first + length))
        return [item for at, item in enumerate(items) if at not in gone]

    return change


def doubled(share: float) -> Change:
    """Put a share of the frames in twice: same bytes, IP identification and time."""
    return lambda items, chance: [one for item in items for one in [item] * (1 + (chance.random() < share))]


def doubled_later(share: float, after_ns: int) -> Change:
    """Put a share of the frames in twice: same bytes and IP identification, the second one later."""

    def change(items, chance):
        again = [item._replace(time_ns=item.time_ns + after_ns) for item in items if chance.random() < share]
        return sorted([*items, *again], key=lambda item: item.time_ns)

    return change


PORT = 36
"""Where a frame has the destination port: Ethernet, and IPv4 without options."""


def internet_checksum(data):
    """Return the checksum of RFC 1071."""
    total = sum(struct.unpack(f">{(len(data) + 1) // 2}H", bytes(data) + bytes(len(data) % 2)))
    return ~(total % 0xFFFF) & 0xFFFF


def summed(data):
    """Return a frame with the checksums of IPv4 and UDP that its sender's network card would have made."""
    frame = bytearray(data)
    frame[24:26] = frame[40:42] = bytes(2)
    struct.pack_into(">H", frame, 24, internet_checksum(frame[14:34]))
    pseudo = bytes(frame[26:34]) + struct.pack(">HH", 17, len(frame) - 34)
    struct.pack_into(">H", frame, 40, internet_checksum(pseudo + frame[34:]) or 0xFFFF)
    return frame


def flipped(data, chance, first=42):
    """Return a frame with one bit turned over on its way, behind so many bytes."""
    frame = summed(data)
    frame[chance.randrange(first, len(frame))] ^= 1 << chance.randrange(8)
    return bytes(frame)


def is_to(data, *ports):
    """Tell whether a frame is a UDP datagram to one of these ports."""
    udp = data[12:14] == b"\x08\0" and data[23] == 17
    return udp and int.from_bytes(data[PORT : PORT + 2], "big") in ports


def damaged(share: float, *ports: int) -> Change:
    """Turn a bit over in a share of the datagrams to some ports, as a network does."""
    return lambda items, chance: [
        item._replace(data=flipped(item.data, chance))
        if is_to(item.data, *ports) and chance.random() < share
        else item
        for item in items
    ]


def displaced(within_ns: int = SECOND) -> Change:
    """Change the order of the records, each by at most so much; times stay."""
    return lambda items, chance: sorted(items, key=lambda item: item.time_ns + chance.randrange(within_ns))


def cut_off(most: int) -> Change:
    """Keep so many bytes of each frame."""
    return lambda items, _: [item._replace(data=item.data[:most]) for item in items]


def jittered(most_ns: int) -> Change:
    """Let times be late by a random part of ``most_ns``; the records stay in the order of time."""

    def change(items, chance):
        moved = [item._replace(time_ns=item.time_ns + chance.randrange(most_ns)) for item in items]
        return sorted(moved, key=lambda item: item.time_ns)

    return change


def shaken(most_ns: int) -> Change:
    """Let times be late by a random part of ``most_ns``; the records stay where they are."""
    return lambda items, chance: [
        item._replace(time_ns=item.time_ns + chance.randrange(most_ns)) for item in items
    ]


def late(by_ns: int, *ports: int) -> Change:
    """Let what goes to some ports be late, as of another interface; the records are in the order of time."""

    def change(items, _):
        moved = [item._replace(time_ns=item.time_ns + by_ns * is_to(item.data, *ports)) for item in items]
        return sorted(moved, key=lambda item: item.time_ns)

    return change


def only_to(*ports: int) -> Change:
    """Keep what goes to some ports."""
    return lambda items, _: [item for item in items if is_to(item.data, *ports)]


def without_one(*ports: int) -> Change:
    """Leave out one datagram, any of those to some ports."""

    def change(items, chance):
        gone = chance.choice([at for at, item in enumerate(items) if is_to(item.data, *ports)])
        return items[:gone] + items[gone + 1 :]

    return change


def stepped(by_ns: int) -> Change:
    """Set the capture's clock somewhere between a quarter and three quarters of the records."""

    def change(items, chance):
        place = chance.randrange(len(items) // 4, 3 * len(items) // 4)
        return [item._replace(time_ns=item.time_ns + by_ns * (at >= place)) for at, item in enumerate(items)]

    return change


def part(start: float, end: float) -> Change:
    """Keep what lies between two shares of the time."""

    def change(items, _):
        first, last = items[0].time_ns, max(item.time_ns for item in items)
        edges = first + start * (last - first), first + end * (last - first)
        return [item for item in items if edges[0] <= item.time_ns <= edges[1]]

    return change


def without_middle(start: float, end: float) -> Change:
    """Leave out what lies between two shares of the time."""

    def change(items, chance):
        inside = set(map(id, part(start, end)(items, chance)))
        return [item for item in items if id(item) not in inside]

    return change


def without_telemetry(msg_id: int) -> Change:
    """Leave out one MsgId of telemetry on TO's link, UDP port 1235."""

    def change(items, _):
        head = struct.pack(">H", msg_id)
        return [item for item in items if not (item.data[36:38] == b"\x04\xd3" and item.data[42:44] == head)]

    return change


CHANGES: dict[str, Change] = {
    "1 % removed": removed(0.01),
    "5 % removed": removed(0.05),
    "30 % removed": removed(0.3),
    "3 runs removed": without_runs(3),
    "20 runs removed": without_runs(20),
    "1 % doubled": doubled(0.01),
    "5 % doubled": doubled(0.05),
    "5 % doubled 40 us later": doubled_later(0.05, 40_000),
    "5 % doubled 3 us later": doubled_later(0.05, 3_000),
    "5 % doubled 50 ms later": doubled_later(0.05, 50_000_000),
    "displaced by up to 1 s": displaced(),
    **{f"cut to {most}": cut_off(most) for most in (64, 80, 96, 112, 128)},
    "times late by up to 20 ms": jittered(20_000_000),
    "times late by up to 200 ms": jittered(200_000_000),
    "times late, in the order of the file": shaken(200_000_000),
    "clock set ahead by 300 s": stepped(300 * SECOND),
    "clock set back by 300 s": stepped(-300 * SECOND),
    "the first half": part(0, 0.5),
    "the second half": part(0.5, 1),
    "without the middle": without_middle(0.4, 0.6),
    **{
        f"without 0x{msg_id:04x}": without_telemetry(msg_id)
        for msg_id in (0x800, 0x801, 0x803, 0x804, 0x805, 0x808, 0x827, 0x884)
    },
}
"""What is done to a capture, by name."""


def changed(items: list[Frame], name: str, seed: int) -> list[Frame]:
    """Return a capture changed in one way; the same seed gives the same."""
    return CHANGES[name](items, random.Random(f"{name} {seed}"))
