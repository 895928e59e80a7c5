from __future__ import annotations

import struct
from typing import NamedTuple

import pytest
from places import CAPTURES


class Captured(NamedTuple):
    time_ns: int
    source_port: int
    destination_port: int
    payload: bytes


@pytest.fixture(scope="session")
def captured():
    """Read a sample: Ethernet, IPv4, no options, microseconds; independent of the code under test."""

    def read(name: str) -> list[Captured]:
        data, at, out = (CAPTURES / f"{name}.pcap").read_bytes(), 24, []
        while at < len(data):
            seconds, micros, length = struct.unpack_from("<III", data, at)
            frame = data[at + 16 : at + 16 + length]
            at += 16 + length
            ports = struct.unpack_from(">HH", frame, 34)
            out.append(Captured(seconds * 10**9 + micros * 1000, *ports, frame[42:]))
        return out

    return read
