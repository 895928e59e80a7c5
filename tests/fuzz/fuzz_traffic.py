"""Traffic of a cFS made of bytes: every four are a step that sends valid packets, at any time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.model import Endpoint, Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import ENVELOPE_FORMATS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from edoras_tools.io.frames.frame_batch import FrameBatch

START_NS = 10**18
MOST = 60
"""Steps of one input."""
STEPS_NS = (
    *(0, 1, 10**6, 4 * 10**6, 10**8, 2 * 10**8, 5 * 10**8, 10**9, 11 * 10**9, 10**11),
    *(-(10**6), -(10**9), -(10**10)),
)
MSG_IDS = (
    *(0x827, 0x828, 0x829, 0x82A, 0x82B, 0x1827, 0x1828, 0x1829, 0x182A),
    *(0x800, 0x880, 0x8FA, 0x1806, 0x1FFF, 0),
)
HOSTS = ("127.0.0.1", "10.0.0.2", "10.0.0.3", "fd00::7")
EVENTS = (
    ("CFE_SB", 17, "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"),
    ("CFE_SB", 25, "Pipe Overflow,MsgId 0x828,pipe TO_LAB_TLM_PIPE,sender EDORAS_APP"),
    ("CFE_SB", 14, "No subscribers for MsgId 0x18ee,sender CI_LAB_APP"),
    ("CFE_SB", 21, "Send Err:Invalid MsgId(0x2827)in msg,App CI_LAB_APP"),
    ("CFE_SB", 17, "Msg Limit Err,MsgId 0x"),
    ("CI_LAB_APP", 8, "CI: L369, cmd 1827 00 dropped, bad length=7"),
    ("CFE_ES", 10, "Restart Application EDORAS_APP Completed, AppID=7"),
    ("CFE_ES", 8, "Stop Application EDORAS_APP Completed."),
    ("CFE_EVS", 44, "Events squelched, AppName = CFE_SB"),
    ("SBN", 259, "disconnected peer 66:3"),
    ("TO_LAB_APP", 3, "TO telemetry output enabled for IP 127.0.0.1"),
    ("", 65535, ""),
)
TWIST = TypeStore().encode("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}})


def traffic(data: bytes) -> Iterator[tuple[int, Endpoint, Endpoint, bytes]]:
    """Yield datagrams as (time, source, destination, payload)."""
    now = START_NS
    for at in range(0, min(len(data), 4 * MOST) - 3, 4):
        when, kind, which, count = data[at : at + 4]
        now += STEPS_NS[when % len(STEPS_NS)]
        host = HOSTS[when >> 6]
        for number in range(1 + (count & 15 if when & 32 else 0)):
            ends, payload = _datagram(kind, which, (count + number) & 0xFF, host, now - START_NS)
            yield now + number * 1000, *ends, payload


def batches(data: bytes) -> FrameBatch:
    """Return the frames of all of it."""
    made = list(traffic(data)) or [(START_NS, Endpoint(HOSTS[0], 1), Endpoint(HOSTS[0], 2), b"")]
    frames = frames_of(made)
    if data and data[0] & 1:
        frames = replace(frames, length=np.minimum(frames.length, 40 + data[0]))
    return frames


def _datagram(
    kind: int, which: int, count: int, host: str, since_ns: int
) -> tuple[tuple[Endpoint, Endpoint], bytes]:
    ci, ground = Endpoint(host, 1234), Endpoint(host, 1235)
    to, peer, bridge = Endpoint(host, 49152 + (which & 1)), Endpoint(host, 2234), Endpoint(host, 2236)
    msg_id = MSG_IDS[which % len(MSG_IDS)]
    clock = max(1_000_000 + since_ns // 10**9 - (500 if which & 64 else 0), 0)
    body = ENVELOPE_FORMATS[which % len(ENVELOPE_FORMATS)].emit(TWIST) + bytes(which & 8)

    def telemetry(number: int, payload: bytes) -> bytes:
        return cfe.emit_telemetry(
            number & 0xEFFF, payload, seconds=clock, subseconds=count << 8, sequence_count=count * (which & 3)
        )

    match kind % 11:
        case 0:
            return (ground, ci), cfe.emit_command(msg_id | 0x1000, count & 3, body, sequence_flags=0)
        case 1:
            return (to, ground), telemetry(msg_id, body)
        case 2:
            app, number, text = EVENTS[which % len(EVENTS)]
            fields = {"app_name": app, "event_id": number, "event_type": count & 3, "message": text}
            return (to, ground), telemetry(
                cfe.EVENT_MSG_ID,
                cfe.EVENT.emit(
                    {**fields, "spacecraft_id": 66, "processor_id": 1 + (which >> 7), "spare": b""}
                ),
            )
        case 3:
            names = [slot.field.name for slot in cfe.SOFTWARE_BUS_HOUSEKEEPING.slots]
            values = dict.fromkeys(names, count * 7 & 255)
            return (to, ground), telemetry(0x803, cfe.SOFTWARE_BUS_HOUSEKEEPING.emit(values))
        case 4:
            return (to, ground), telemetry(0x884, bytes(12) + count.to_bytes(4, "little") + bytes(8))
        case 5:
            ends = (peer, bridge) if which & 1 else (bridge, peer)
            inner = telemetry(msg_id, body) if which & 2 else cfe.emit_command(msg_id | 0x1000, 1, body)
            return ends, sbn.emit(sbn.MsgType.APP, Peer(66, 1 + (which & 3)), inner)
        case 6:
            kinds = list(sbn.MsgType)
            return (bridge, peer), sbn.emit(kinds[which % len(kinds)], Peer(66, 3), sbn.emit_proto())
        case 7:
            wanted = sbn.emit_subscriptions([sbn.Subscription(msg_id)])
            subscribes = sbn.MsgType.SUB if which & 1 else sbn.MsgType.UNSUB
            return (bridge, peer), sbn.emit(subscribes, Peer(66, 3), wanted)
        case 8:
            address = host.encode().ljust(16, b"\0")
            return (ground, ci), cfe.emit_command(0x1880, which & 7, address)
        case 9:
            return (Endpoint(host, 8080), Endpoint(host, 8585)), TWIST[4:52].ljust(48, b"\0")
        case _:
            target = Endpoint(host, (1234, 1235, 2236, 5353)[which & 3])
            return (Endpoint(host, 5004), target), bytes([which]) * count


def write_seeds(folder: Path) -> None:
    """Write some inputs: one that has each kind, commands with telemetry, a peer that comes and goes."""
    made = {
        "each_kind": bytes(value for kind in range(11) for value in (4, kind, kind, kind)),
        "commands": bytes(
            value for at in range(50) for value in (4 if at % 9 else 36, (0, 1, 3, 4)[at % 4], 5, at)
        ),
        "events": bytes(value for at in range(len(EVENTS)) for value in (6, 2, at, 3)),
        "peers": bytes(value for at in range(40) for value in (7, (5, 6, 7)[at % 3], at * 5, at)),
        "backwards": bytes(value for at in range(40) for value in (10 + at % 3, at % 11, at * 7 & 255, at)),
        "strangers": bytes(
            value for at in range(40) for value in (4 + 64 * (at % 4), (10, 0, 1)[at % 3], at, 40)
        ),
        "cut": bytes([5]) + bytes(value for at in range(40) for value in (4, at % 5, 5, at)),
    }
    for name, data in made.items():
        (folder / name).write_bytes(bytes([len(name) % 3]) + data)
