"""Bytes that nobody sane sends: no Lua error, and still the answer of our own decoder."""

import random
import struct
from contextlib import closing

import pytest
from effort import examples, long_but
from places import ROOT
from scapy.layers.inet import UDP

from edoras_tools.decode import Context, Dissector, Options
from edoras_tools.dissectors import scapy_layers
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.model import Peer
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import ENVELOPE_FORMATS

ROVERS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
PORTS = [(1235, 1234), (40000, 1235), (1235, 1236), (2236, 2234), (2234, 2236), (2235, 5000), (1235, 5001)]
TYPES = TypeStore()
ZOO = """\
bool yes
bool[3] truths
int8 small
uint8[] blob
byte[4] quad
char letter
int16 i16
uint16[2] pair
int32[] numbers
uint32 u32
int64 huge
uint64[] huges
float32 f
float32[] fs
float64[3] vector
string text
string<=8 bounded
string[] texts
string[2] two
wstring wide
wstring[<=3] wides
Inner inner
Inner[] inners
Inner[2] both
Nothing nothing
Nothing[] nothings
"""
INNER = "uint8 a\nfloat64 b\nstring name\nDeep[<=4] deep\n"
DEEP = "int64[] q\nuint16 x\n"
VALUES = {
    "yes": True,
    "truths": [True, False, True],
    "small": -5,
    "blob": [1, 2, 255],
    "quad": [9, 8, 7, 6],
    "letter": 65,
    "i16": -300,
    "pair": [1, 65535],
    "numbers": [-1, 0, 1, 2**31 - 1],
    "u32": 2**32 - 1,
    "huge": -(2**63),
    "huges": [2**64 - 1, 0],
    "f": 0.1,
    "fs": [1.5, -0.0, float("inf"), float("-inf")],
    "vector": [1e-310, 0.1, -1e300],
    "text": "grüße → 火星",
    "bounded": "12345678",
    "texts": ["", "a", "bc"],
    "two": ["x", "yy"],
    "wide": "wide 𝄞",
    "wides": ["", "é"],
    "inner": {"a": 1, "b": 2.5, "name": "n", "deep": [{"q": [1, -2], "x": 7}, {"q": [], "x": 8}]},
    "inners": [{"a": 3, "b": 0.0, "name": "", "deep": []}, {"a": 4, "b": 1.0, "name": "m", "deep": []}],
    "both": [{"a": 5, "b": 0.0, "name": "", "deep": []}, {"a": 6, "b": -1.0, "name": "", "deep": []}],
    "nothings": [{}, {}],
}


def envelope(cdr, form=ENVELOPE_FORMATS[0], room=0):
    return form.emit(cdr) + bytes(room)


TWIST = TYPES.encode("geometry_msgs/msg/Twist", {"linear": {"x": 1.5}, "angular": {"z": -0.25}})
POSE = TYPES.encode(
    "geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "map"}, "pose": {"position": {"x": 2}}}
)
PEER = Peer(66, 3)
KINDS = {
    "command": (0, cfe.emit_command(0x1827, 1, envelope(TWIST))),
    "own command": (0, cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0"))),
    "telemetry": (1, cfe.emit_telemetry(0x0828, envelope(POSE, room=16), sequence_count=7)),
    "event": (1, cfe.emit_telemetry(0x0808, cfe.EVENT.emit({"app_name": "APP", "message": "words"}))),
    "housekeeping": (1, cfe.emit_telemetry(0x0803, bytes(28))),
    "wake-up": (4, sbn.emit(3, PEER, bytes.fromhex("0827c00000010000"))),
    "app": (3, sbn.emit(3, PEER, cfe.emit_command(0x1829, 1, envelope(POSE)))),
    "subscriptions": (
        3,
        sbn.emit(1, PEER, sbn.emit_subscriptions([sbn.Subscription(0x82A + i) for i in range(5)])),
    ),
    "protocol": (4, sbn.emit(4, PEER, sbn.emit_proto())),
    "heartbeat": (4, sbn.emit(0xA0, PEER)),
    "legacy": (3, b"\0\x01\x04\0\0\0\x03\x0b"),
}


def mangled(count, seed):
    """Yield datagrams: good ones with bytes changed, cut or added, lengths above all; and noise."""
    chance = random.Random(seed)
    kinds = [(PORTS[port], data) for port, data in KINDS.values()]
    for _ in range(count):
        ports, good = chance.choice(kinds)
        data = bytearray(good)
        for _ in range(chance.randrange(4)):
            at = (
                chance.randrange(len(data))
                if chance.random() < 0.5
                else min(chance.randrange(40), len(data) - 1)
            )
            data[at] = chance.choice((0, 1, 4, 127, 128, 255, chance.randrange(256)))
        if chance.random() < 0.3:
            data = data[: chance.randrange(len(data) + 1)]
        if chance.random() < 0.2:
            data += chance.randbytes(chance.randrange(60))
        if chance.random() < 0.05:
            data = bytearray(chance.randbytes(chance.randrange(1, 1400)))
        if chance.random() < 0.1:
            ports = chance.choice(PORTS)
        yield (*ports, bytes(data))


def compared(capture, frames, context, judge):
    dissector = Dissector(context)
    with closing(open_file(capture)) as source:
        for batch in source.batches():
            for row in range(len(batch)):
                judge(dissector.dissect(batch[row]), frames[int(batch.number[row])])


def test_fuzzed_datagrams(tshark, write_pcap, tmp_path, judge):
    capture = write_pcap(tmp_path / "fuzz.pcap", mangled(examples(20_000, 40), seed=4))
    frames = tshark(*ROVERS).frames(capture)
    compared(capture, frames, Context(load(ROVERS), TYPES, structs=Structs()), judge)


@pytest.mark.quick("*4/4*")
@pytest.mark.parametrize(
    "options",
    [
        Options(extended_header=True),
        Options(msg_id_version=2),
        Options(telemetry_header=12, envelope="auto"),
        Options(envelope="4/4 be", ports=((SBN, 5000), (TO, 5001))),
        Options(envelope="1/1"),
    ],
    ids=str,
)
def test_fuzzed_datagrams_under_other_options(options, tshark, write_pcap, tmp_path, judge):
    capture = write_pcap(tmp_path / "fuzz.pcap", mangled(examples(1500, 12), seed=5))
    frames = tshark(*ROVERS, options=options).frames(capture)
    compared(capture, frames, Context(load(ROVERS), TYPES, options, Structs()), judge)


@pytest.mark.long
def test_every_length_of_every_kind(tshark, write_pcap, tmp_path, judge):
    cut = [(*PORTS[port], data[:end]) for port, data in KINDS.values() for end in range(len(data) + 1)]
    capture = write_pcap(tmp_path / "cut.pcap", cut)
    frames = tshark(*ROVERS).frames(capture)
    compared(capture, frames, Context(load(ROVERS), TYPES, structs=Structs()), judge)


def test_what_the_capture_cut_is_not_blamed(tshark, write_pcap, tmp_path, judge):
    rows = [(*PORTS[port], data) for port, data in KINDS.values()]
    capture = write_pcap(tmp_path / "snapped.pcap", rows, snaps=(28, 29, 35, 50, 80, 110))
    frames = tshark(*ROVERS).frames(capture)
    compared(capture, frames, Context(load(ROVERS), TYPES, structs=Structs()), judge)


@pytest.fixture(scope="module")
def zoo(tmp_path_factory):
    """A mission whose message has every kind of field there is."""
    folder = tmp_path_factory.mktemp("zoo")
    package = folder / "zoo_msgs/msg"
    package.mkdir(parents=True)
    for name, text in {"Zoo": ZOO, "Inner": INNER, "Deep": DEEP, "Nothing": ""}.items():
        (package / f"{name}.msg").write_text(text)
    mission = folder / "zoo.yaml"
    text = ROVERS[0].read_text().replace("geometry_msgs/msg/Twist", "zoo_msgs/msg/Zoo")
    mission.write_text(text)
    return mission, folder


@pytest.mark.parametrize("distro", long_but(["humble"], ["humble", "jazzy"]))
def test_every_kind_of_field_in_both_byte_orders(distro, zoo, tshark, write_pcap, tmp_path, judge):
    mission, folder = zoo
    types = TypeStore(distro, [folder])
    chance = random.Random(6)
    rows = []
    for big in (False, True):
        for values in (VALUES, {}, {"text": "nul\0inside"}):
            cdr = types.encode("zoo_msgs/msg/Zoo", values, big_endian=big)
            rows.append((1235, 1234, cfe.emit_command(0x1827, 1, envelope(cdr))))
            for _ in range(examples(150, 3)):
                data = bytearray(cdr)
                for _ in range(chance.randrange(1, 3)):
                    data[chance.randrange(4, len(data))] = chance.choice(
                        (0, 1, 2, 3, 255, chance.randrange(256))
                    )
                cut = bytes(data[: chance.choice((len(data), chance.randrange(4, len(data))))])
                rows.append((1235, 1234, cfe.emit_command(0x1827, 1, envelope(cut))))
    capture = write_pcap(tmp_path / "zoo.pcap", rows)
    frames = tshark(mission, msg_paths=[folder], distro=distro).frames(capture)
    messages = 0

    def count(packet, frame):
        nonlocal messages
        messages += packet.message is not None
        judge(packet, frame, types)

    compared(capture, frames, Context(load(mission), types, structs=Structs()), count)
    assert messages > 100


def test_scapy_takes_any_bytes():
    scapy_layers.use({0x1827: "geometry_msgs/msg/Twist", 0x0828: "geometry_msgs/msg/PoseStamped"}, TYPES)
    try:
        for source, destination, data in mangled(examples(3000), seed=7):
            datagram = struct.pack(">HHHH", source, destination, 8 + len(data), 0) + data
            read = UDP(datagram)
            assert bytes(read) == datagram
            read.show(dump=True)
    finally:
        scapy_layers.use({})
