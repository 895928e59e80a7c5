"""Write captures that are hard on whoever reads them.

Many sources, MsgIds, pairs of both, images, garbled times, and losses throughout at one counter.

Run: python benchmarks/hostile.py KIND FILE [NUMBER]      (KIND: see ``KINDS``)
"""

from __future__ import annotations

import argparse
import random
import struct
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.model import Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Record = tuple[int, int, bytes]
    """Seconds, microseconds, frame."""

START_S, STEP_US = 1_795_241_000, 1000
ROVER = Path(__file__).parents[1] / "samples" / "captures" / "a_rover.pcap"
GROUND, CFS = bytes([127, 0, 0, 1]), bytes([127, 0, 0, 1])
CI, TO = 1234, 1235
COMMANDS, TELEMETRY = range(0x1800, 0x2000), range(0x800, 0x1000)
IMAGE_BYTES = 1250
LOSSY = 12


def frame(source: bytes, source_port: int, port: int, payload: bytes, target: bytes = CFS) -> bytes:
    """Return a datagram behind Ethernet, IPv4 and UDP headers."""
    udp = struct.pack(">HHHH", source_port, port, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + source + target
    return bytes(12) + b"\x08\x00" + ip + udp


def datagram(source: bytes, source_port: int, msg_id: int, body: bytes, count: int = 0) -> bytes:
    """Return a command to CI, or telemetry from TO."""
    if msg_id & 0x1000:
        packet = cfe.emit_command(msg_id, 1, body, sequence_flags=0, with_checksum=False)
        return frame(source, source_port, CI, packet)
    return frame(source, source_port, TO, cfe.emit_telemetry(msg_id, body, sequence_count=count & 0x3FFF))


def twist() -> bytes:
    """Return a Twist in its envelope."""
    return DEFAULT.emit(TypeStore().encode("geometry_msgs/msg/Twist", {}))


def spaced(frames: Iterator[bytes]) -> Iterator[Record]:
    """Give each frame its time."""
    for number, octets in enumerate(frames):
        second, microsecond = divmod(number * STEP_US, 1_000_000)
        yield START_S + second, microsecond, octets


def address(number: int) -> tuple[bytes, int]:
    """Return the address and port of a source by its number."""
    return struct.pack(">I", 0x0A000001 + number // 4), 40_000 + number % 4


def sources(number: int) -> Iterator[Record]:
    """One command from each of so many sources."""
    body = twist()
    return spaced(datagram(*address(place), 0x1827, body) for place in range(number))


def telemetry_sources(number: int) -> Iterator[Record]:
    """One pose from each of so many sources, each with a count of its own."""
    body = twist()
    return spaced(datagram(*address(place), 0x827, body, place) for place in range(number))


def telemetry_pairs(number: int) -> Iterator[Record]:
    """One telemetry packet of each of so many pairs of MsgId and source."""
    body, side = twist(), max(1, round(number**0.5))
    return spaced(
        datagram(*address(place // side), TELEMETRY[place % side], body, place) for place in range(number)
    )


def sbn_sources(number: int) -> Iterator[Record]:
    """One SBN message from each of so many peers."""
    body = cfe.emit_telemetry(0x827, twist())
    return spaced(
        frame(*address(place), 2236, sbn.emit(sbn.MsgType.APP, Peer(1 + place, 0x42), body))
        for place in range(number)
    )


def strangers(number: int) -> Iterator[Record]:
    """One datagram from each of so many sources to as many ports that no link has."""
    return spaced(frame(*address(place), 10_000 + place % 50_000, b"stranger") for place in range(number))


def msg_ids(number: int) -> Iterator[Record]:
    """One packet of each of so many MsgIds (commands and telemetry in turn, 4,094 at most), four times."""
    body = twist()
    every = [item for pair in zip(COMMANDS, TELEMETRY, strict=True) for item in pair][2:][:number]
    return spaced(
        datagram(GROUND, 50_000 if msg_id & 0x1000 else 50_001, msg_id, body, turn)
        for turn in range(4)
        for msg_id in every
    )


def pairs(number: int) -> Iterator[Record]:
    """One datagram of each of so many pairs of MsgId and source: as many MsgIds as sources."""
    body, side = twist(), max(1, round(number**0.5))
    return spaced(
        datagram(*address(place // side), COMMANDS[1 + place % side], body) for place in range(number)
    )


def images(number: int) -> Iterator[Record]:
    """Telemetry of so many images of 1.3 kB."""
    types, dice = TypeStore(), random.Random(1)
    pixels = [dice.randbytes(IMAGE_BYTES) for _ in range(16)]
    bodies = [
        DEFAULT.emit(types.encode("sensor_msgs/msg/Image", {"height": 1, "width": IMAGE_BYTES, "data": item}))
        for item in pixels
    ]
    return spaced(
        datagram(GROUND, 50_001, 0x827, bodies[place % len(bodies)], place) for place in range(number)
    )


def overload(number: int) -> Iterator[Record]:
    """Telemetry of which a third is lost throughout, on twelve MsgIds that share the counter of 0x803.

    Each is published at 10 Hz; TO sends three or four of each five after 500 ms, and
    the housekeeping of the bus says each 4 s how many were lost.
    """
    body, layout = twist(), cfe.SOFTWARE_BUS_HOUSEKEEPING
    counts, lost, turn, sent, housekeeping = [0] * LOSSY, 0, 0, 0, 0
    while sent < number:
        at_us, said = turn * 500_000, []
        for place in range(LOSSY):
            # Of fifteen published in three rounds ten are let in.
            kept = (4, 3, 3)[(turn + place) % 3]
            said += [(TELEMETRY[0x27 + place], counts[place] + step, body) for step in range(kept)]
            counts[place] += 5
            lost += 5 - kept
        if turn % 8 == 0:
            values = {"message_limit_error_counter": lost & 0xFFFF}
            said.append((0x803, housekeeping, layout.emit(values)))
            housekeeping += 1
        for place, (msg_id, count, content) in enumerate(said[: number - sent]):
            second, microsecond = divmod(at_us + place * 50, 1_000_000)
            packet = cfe.emit_telemetry(
                msg_id,
                content,
                sequence_count=count & 0x3FFF,
                seconds=1_000_000 + second,
                subseconds=(microsecond << 16) // 1_000_000,
            )
            yield START_S + second, microsecond, frame(GROUND, 50_001, TO, packet)
        sent += len(said)
        turn += 1


def rover() -> list[Record]:
    """Return the records of a real capture."""
    data, at, found = ROVER.read_bytes(), 24, []
    while at < len(data):
        second, microsecond, length = struct.unpack_from("<III", data, at)
        found.append((second, microsecond, data[at + 16 : at + 16 + length]))
        at += 16 + length
    return found


def boots(number: int) -> Iterator[Record]:
    """A real capture so many times, one behind the other: cFS was started again each time."""
    records = rover()
    length = records[-1][0] - records[0][0] + 2
    for turn in range(number):
        yield from ((second + turn * length, microsecond, octets) for second, microsecond, octets in records)


def times(seed: int, share: float = 0.3) -> Iterator[Record]:
    """A real capture of which a share of the times is garbled: bits, zeros, ends of the range, years away."""
    dice = random.Random(seed)
    garbled: tuple[Callable[[int], int], ...] = (
        lambda _: 0,
        lambda _: 0xFFFFFFFF,
        lambda second: second ^ 1 << dice.randrange(32),
        lambda _: dice.randrange(1 << 32),
        lambda second: second + dice.choice([-1, 1]) * 10 ** dice.randrange(2, 9),
    )
    for second, microsecond, octets in rover():
        if dice.random() < share:
            yield dice.choice(garbled)(second) & 0xFFFFFFFF, microsecond, octets
        else:
            yield second, microsecond, octets


def write(path: Path, records: Iterator[Record]) -> None:
    """Write a pcap."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for second, microsecond, octets in records:
            file.write(struct.pack("<IIII", second, microsecond, len(octets), len(octets)) + octets)


KINDS: dict[str, Callable[[int], Iterator[Record]]] = {
    "sources": sources,
    "telemetry_sources": telemetry_sources,
    "sbn_sources": sbn_sources,
    "strangers": strangers,
    "telemetry_pairs": telemetry_pairs,
    "msg_ids": msg_ids,
    "pairs": pairs,
    "images": images,
    "times": times,
    "overload": overload,
    "boots": boots,
}


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("path", type=Path)
    parser.add_argument("number", type=int, nargs="?", default=20_000)
    options = parser.parse_args()
    write(options.path, KINDS[options.kind](options.number))


if __name__ == "__main__":
    main()
