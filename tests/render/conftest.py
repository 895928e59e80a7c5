"""Hand-made packets: what decode gives for small, telling datagrams."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import pytest

from edoras_tools.errors import TruncatedError
from edoras_tools.links.bare import CI as CI_LINK
from edoras_tools.links.bare import TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import (
    OTHER,
    Datagram,
    Decoded,
    Endpoint,
    Finding,
    Layer,
    LayerField,
    Peer,
    RosMessage,
)
from edoras_tools.wire import ccsds, cfe, envelope, sbn

START_NS = 1_795_241_802_553_538_000
HEADERS = 42
"""Bytes of Ethernet, IPv4 and UDP headers in front of the payload."""


def layer(layout, data, at, *extra):
    values = layout.parse(data, at)
    fields = [
        LayerField(
            slot.field.name,
            values[slot.field.name],
            at + slot.start,
            at + slot.end,
            slot.field.text(values[slot.field.name]),
            slot.field.doc,
        )
        for slot in layout.slots
    ]
    return Layer(layout.name, layout.title, at, at + layout.size, (*extra, *fields))


def packet_layer(data, at, name):
    word = int.from_bytes(data[at : at + 2], "big")
    text = f"0x{word:04x} {name}".strip()
    return layer(ccsds.PRIMARY, data, at, LayerField("msg_id", word, at, at + 2, text))


def datagram(number, seconds, payload, source, destination):
    frame = bytes(HEADERS) + payload
    time_ns = START_NS + round(seconds * 1e9)
    return Datagram(number, time_ns, 1, frame, payload, HEADERS, len(frame), source, destination)


GROUND = Endpoint("127.0.0.1", 40123)
CI = Endpoint("127.0.0.1", 1234)


def twist():
    values = {"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.25}}
    body = b"\0\1\0\0" + struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.25)
    data = cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(body), sequence_flags=0, with_checksum=False)
    leaves = [(f"{part}.{axis}", value) for part, axes in values.items() for axis, value in axes.items()]
    fields = [LayerField(name, value, 28 + 8 * i, 36 + 8 * i) for i, (name, value) in enumerate(leaves)]
    layers = (
        packet_layer(data, 0, "/cmd_vel"),
        layer(cfe.COMMAND, data, 6),
        layer(envelope.DEFAULT.layout, data, 8),
        layer(envelope.ENCAPSULATION, data, 24),
        Layer("ros", "geometry_msgs/msg/Twist", 28, 76, tuple(fields)),
    )
    return Decoded(
        datagram(1, 0, data, GROUND, CI),
        CI_LINK,
        layers,
        Finding.CHECKSUM_ABSENT | Finding.SEQUENCE_UNSET,
        RosMessage("geometry_msgs/msg/Twist", "/cmd_vel", values, body),
        summary="linear.x=0.5 angular.z=-0.25",
    )


def event():
    message = "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"
    data = cfe.emit_telemetry(
        0x808,
        cfe.EVENT.emit({"app_name": "CFE_SB", "event_id": 17, "event_type": 3, "message": message}),
        seconds=1_000_123,
        subseconds=32768,
        sequence_count=7,
    )
    layers = (
        packet_layer(data, 0, "EVS_LONG_EVENT"),
        layer(cfe.TELEMETRY, data, 6),
        layer(cfe.EVENT, data, 16),
    )
    ends = Endpoint("10.0.0.2", 1236), Endpoint("192.168.100.5", 1235)
    return Decoded(datagram(2, 1.25, data, *ends), TO, layers, Finding(0), summary=f"CFE_SB 17: {message}")


def subscriptions():
    wanted = [0x1827, 0x1828, 0x1829, 0x182A]
    payload = sbn.emit_subscriptions(sbn.Subscription(item) for item in wanted)
    data = sbn.emit(sbn.MsgType.SUB, Peer(66, 3), payload)
    layers = [layer(sbn.HEADER, data, 0), layer(sbn.SUBSCRIPTIONS, data, 11)]
    layers += [layer(sbn.SUBSCRIPTION, data, 61 + 6 * index) for index in range(len(wanted))]
    ends = Endpoint("127.0.0.1", 2236), Endpoint("127.0.0.1", 2234)
    summary = "0x1827, 0x1828, 0x1829 and 1 more from 66:3"
    return Decoded(datagram(3, 2.5, data, *ends), SBN, tuple(layers), Finding(0), summary=summary)


def disconnect():
    data = sbn.emit(sbn.MsgType.DISCONNECT, Peer(66, 3)) + b"tail"
    ends = Endpoint("127.0.0.1", 2236), Endpoint("127.0.0.1", 2234)
    return Decoded(
        datagram(4, 2.75, data, *ends),
        SBN,
        (layer(sbn.HEADER, data, 0),),
        Finding.SBN_SIZE_MISMATCH,
        summary="from 66:3",
    )


def truncated():
    data = bytes.fromhex("18270000004501")
    return Decoded(
        datagram(5, 3, data, GROUND, CI),
        CI_LINK,
        (packet_layer(data, 0, "/cmd_vel"),),
        Finding.TRUNCATED | Finding.LENGTH_MISMATCH | Finding.SEQUENCE_UNSET,
        stop=TruncatedError("cfe_command", 6, 2, 1),
    )


def hostile():
    """A datagram that would clear the screen, turn the text around and ring the bell."""
    text = "\x1b[2J\x1b[31m\x07owned\r\n\u202eevil 你好 e\u0301 👩\u200d🚀"
    data = text.encode()
    ends = Endpoint("fe80::1ff:fe23:4567:890a", 5353), Endpoint("ff02::fb", 5353)
    bad = Layer("ros", text, 0, len(data), (LayerField(text, text, 0, 9, "", text),))
    message = RosMessage(text, text, {text: text}, data)
    return Decoded(datagram(1234567, 100000, data, *ends), OTHER, (bad,), Finding(0), message, summary=text)


@pytest.fixture(scope="session")
def packets():
    made = (twist, event, subscriptions, disconnect, truncated, hostile)
    return {make.__name__: make() for make in made}


@dataclass(frozen=True)
class Golden:
    """Compares text with a file beside the tests."""

    folder: Path

    def __call__(self, name: str, text: str) -> None:
        lines = [line.rstrip() for line in text.splitlines()]
        assert lines == (self.folder / name).read_text().splitlines()


@pytest.fixture(scope="session")
def golden():
    return Golden(Path(__file__).parent / "golden")


@pytest.fixture(scope="session")
def summary():
    """What ``info --json`` prints for a small capture."""
    row = {"type": None, "name": None, "processor_id": None, "gaps": 0, "duplicates": 0, "findings": {}}
    return {
        "source": "a_rover.pcap",
        "kind": "pcap",
        "datagrams": 1827,
        "skipped": 3,
        "start_ns": START_NS,
        "end_ns": START_NS + 65_269_794_000,
        "capture_drops": 0,
        "routes": [
            row
            | {
                "topic": "/cmd_vel",
                "type": "geometry_msgs/msg/Twist",
                "link": "ci",
                "msg_id": "0x1827",
                "count": 600,
                "rate_hz": 10.0,
                "jitter_ms": 0.06,
                "bytes_min": 76,
                "bytes_max": 76,
                "findings": {"checksum_absent": 600, "length_mismatch": 2, "truncated": 1},
            },
            row
            | {
                "topic": "/robot_1/ground/a_topic_with_a_long_name/telemetry_pose",
                "type": "geometry_msgs/msg/PoseStamped",
                "link": "to",
                "msg_id": "0x0827",
                "count": 63,
                "rate_hz": 1.0,
                "jitter_ms": 0.05,
                "gaps": 12,
                "duplicates": 1,
                "bytes_min": 116,
                "bytes_max": 136,
            },
            row
            | {
                "topic": None,
                "name": "EVS_LONG_EVENT",
                "link": "to",
                "msg_id": "0x0808",
                "count": 15,
                "rate_hz": 1.3,
                "jitter_ms": 313.2,
                "bytes_min": 172,
                "bytes_max": 172,
            },
            row
            | {
                "topic": None,
                "name": "SBN_SUB",
                "link": "sbn",
                "msg_id": None,
                "processor_id": 1,
                "count": 1,
                "rate_hz": 0.0,
                "jitter_ms": 0.0,
                "bytes_min": 67,
                "bytes_max": 67,
            },
        ],
        "findings": {"checksum_absent": 600, "truncated": 1, "length_mismatch": 2},
        "warnings": ["mission.yaml: no telemetry"],
    }
