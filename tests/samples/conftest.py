"""What the tests of the samples share: a capture read by hand, with nothing of the package."""

from __future__ import annotations

import importlib.util
import json
import struct
from types import SimpleNamespace

import pytest
from places import SAMPLES


def by_hand(capture):
    """Return every UDP datagram of a little-endian microsecond Ethernet capture, by frame number."""
    data = (SAMPLES / f"captures/{capture}.pcap").read_bytes()
    assert struct.unpack_from("<I2H4xI4xI", data)[:3] == (0xA1B2C3D4, 2, 4)
    found, at, number = {}, 24, 0
    while at < len(data):
        seconds, microseconds, captured, original = struct.unpack_from("<4I", data, at)
        frame = data[at + 16 : at + 16 + captured]
        at, number = at + 16 + captured, number + 1
        assert captured == original
        assert frame[12:14] == b"\x08\x00"
        udp = 14 + 4 * (frame[14] & 15)
        source, destination, length = struct.unpack_from(">3H", frame, udp)
        found[number] = SimpleNamespace(
            number=number,
            time_ns=seconds * 1_000_000_000 + microseconds * 1000,
            source=".".join(map(str, frame[26:30])) + f":{source}",
            destination=".".join(map(str, frame[30:34])) + f":{destination}",
            payload=frame[udp + 8 : udp + length],
        )
    return found


@pytest.fixture(scope="session")
def captures():
    """Every sample capture, read by hand."""
    names = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")
    return {name: by_hand(name) for name in names}


@pytest.fixture(scope="session")
def expected():
    """Every expected decode, from its file."""
    names = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")
    return {name: json.loads((SAMPLES / f"expected/{name}.json").read_text()) for name in names}


@pytest.fixture(scope="session")
def make_expected():
    """The generator script, as a module."""
    spec = importlib.util.spec_from_file_location("make_expected", SAMPLES / "make_expected.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
