"""A session of F Prime's ground system with a rover: what is sent, its frames, and the sample that holds it.

    python tests/support/fprime_session.py

writes ``samples/fprime/rover.pcap``. F Prime's ground system (``.ci/install-fprime``) makes the packets and
the TC frames; TM frames, which it only reads, are made here.
"""

from __future__ import annotations

import json
import struct
import subprocess
from binascii import crc_hqx
from zlib import crc32

from places import ROOT, SUPPORT
from rewriting import Udp, write

HOME = ROOT / ".fprime"
SAMPLES = ROOT / "samples/fprime"
DICTIONARY = SAMPLES / "rover_dictionary.json"
CAPTURE = SAMPLES / "rover.pcap"
TM_BYTES, SPACECRAFT, CHANNEL = 1024, 0x44, 1
POSE = {"x": 1.5, "y": -2.0, "heading": 0.25}
LEG = {"to": POSE, "speeds": [1, 2, 65535], "label": "dock", "mode": "DRIVING"}
GROUND, FLIGHT = ("127.0.0.1", 50001), ("127.0.0.1", 50000)
START_NS = 1_795_000_000 * 10**9


def at(tenths):
    """Return a time tag of the rover's clock."""
    return [2, 0, 1_795_000_000 + tenths // 10, tenths % 10 * 100_000 + 42]


SESSION = [
    {"command": "Rover.cmdDisp.CMD_NO_OP", "args": []},
    {"event": "Rover.cmdDisp.OpCodeDispatched", "args": [0x1000000, 3], "time": at(1)},
    {"command": "Rover.cmdDisp.CMD_NO_OP_STRING", "args": ["hello"]},
    {"event": "Rover.cmdDisp.OpCodeDispatched", "args": [0x1000001, 3], "time": at(2)},
    {"event": "Rover.cmdDisp.NoOpStringReceived", "args": ["hello"], "time": at(2)},
    {
        "channels": [
            ["Rover.cmdDisp.CommandsDispatched", 2],
            ["Rover.version.Project", "v1.2-rc1"],
            ["Rover.drive.Pose", POSE],
            ["Rover.drive.Charging", True],
        ],
        "time": at(10),
    },
    {"command": "Rover.drive.MOVE", "args": [1.5, "DRIVING", True]},
    {"event": "Rover.drive.ModeChanged", "args": ["DRIVING", 0.25, "command", 99], "time": at(12)},
    {"command": "Rover.drive.FOLLOW", "args": [[LEG, {**LEG, "label": ""}], "twice", 2]},
    {"packet": "Motion", "values": ["DRIVING", 12.5, [1, 2, 3, 4]], "time": at(20)},
    {"packet": "About", "values": ["v1.2-rc1", 4], "time": at(20)},
    {"channels": [["Rover.drive.NextLeg", LEG], ["Rover.drive.Wheels", [0, -0.5, 1, 1.5]]], "time": at(20)},
    {"channels": [["Rover.drive.Odometer", 12.75], ["Rover.drive.Odometer", 13]], "time": at(21)},
    {"event": "Rover.drive.Arrived", "args": [POSE, [0, 0, 0, 0]], "time": at(30)},
    {"event": "Rover.drive.ModeChanged", "args": ["LOST", 0, "dust \u00e9", 1 << 63], "time": at(31)},
    {"event": "Rover.drive.Stuck", "args": [], "time": at(32)},
]
"""What is sent, in order."""


def why_not():
    """Return why the ground system is not there, or an empty text."""
    if (HOME / ".installed").exists():
        return ""
    absent = HOME / "absent"
    return absent.read_text().strip() if absent.exists() else "fprime-gds is not installed: make fprime"


def ask(send=(), receive=None):
    """Return what F Prime's ground system makes of packets to send, and of frames that it receives."""
    asked = json.dumps({"send": list(send), "receive": receive or {}})
    done = subprocess.run(
        [HOME / "bin/python", SUPPORT / "fprime_peer.py", DICTIONARY],
        input=asked,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def own(packet):
    """Return a packet in F Prime's own frame."""
    frame = struct.pack(">II", 0xDEADBEEF, len(packet)) + packet
    return frame + struct.pack(">I", crc32(frame))


def space(packet, count=0, apid=None, *, up=False):
    """Return a packet in a space packet."""
    apid = int.from_bytes(packet[:2], "big") if apid is None else apid
    return struct.pack(">HHH", up << 12 | apid, 3 << 14 | count, len(packet) - 1) + packet


def tm(*packets, count=0, size=TM_BYTES, first=0):
    """Return a TM frame of space packets, filled with an idle one; what is too much is cut."""
    data = b"".join(packets)[: size - 8]
    left = size - 8 - len(data)
    if left > 6:
        data += space(bytes([0x44]) * (left - 6), apid=0x7FF)
    head = struct.pack(">HBBH", SPACECRAFT << 4 | CHANNEL << 1, count, count, 3 << 11 | first)
    return head + data + struct.pack(">H", crc_hqx(head + data, 0xFFFF))


def tc(data):
    """Return a TC frame."""
    frame = struct.pack(">HHB", 1 << 13 | SPACECRAFT, CHANNEL << 10 | (len(data) + 6), 0) + data
    return frame + struct.pack(">H", crc_hqx(frame, 0xFFFF))


def frames(answers):
    """Yield of each frame of the session whether it goes to the rover, and its bytes."""
    counts = {}
    waiting = []
    number = 0
    pairs = zip(SESSION, answers, strict=True)
    items = [(("command" in item), bytes.fromhex(told["packet"]), told) for item, told in pairs]
    for index, (up, packet, told) in enumerate(items):
        if up:
            yield True, bytes.fromhex(told["frames"]["ccsds"])
            continue
        counts[packet[:2]] = counts.get(packet[:2], -1) + 1
        waiting.append(space(packet, counts[packet[:2]]))
        if index + 1 == len(items) or items[index + 1][0] or len(waiting) == 3:
            yield False, tm(*waiting, count=number)
            waiting, number = [], number + 1


def datagrams(answers):
    """Return the session as datagrams."""
    return [
        Udp(START_NS + index * 10**8, ("127.0.0.1", 41000 + up), FLIGHT if up else GROUND, frame)
        for index, (up, frame) in enumerate(frames(answers))
    ]


if __name__ == "__main__":
    write(CAPTURE, datagrams(ask(SESSION)["send"]))
