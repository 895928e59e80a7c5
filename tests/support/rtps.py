"""RTPS for tests: the samples, what their peers said, and messages made by hand."""

import json
import struct
from contextlib import closing

import numpy as np
from places import ROOT

from edoras_tools.addons.rtps.link import RTPS_MAGIC
from edoras_tools.addons.rtps.wire import SUBMESSAGE_LAYOUTS, SubmessageKind
from edoras_tools.io.formats.open import open_file

FOLDER = ROOT / "samples/rtps"
CAPTURES = sorted(FOLDER.glob("*.pcap.gz"))
TRUTH = json.loads((FOLDER / "truth.json").read_text())
PREFIX = bytes(range(12))
WRITER = bytes.fromhex("00001203")
READER = bytes.fromhex("00001204")
TWIST = "geometry_msgs::msg::dds_::Twist_"


def batches(path):
    """Return the batches of a file."""
    with closing(open_file(path)) as source:
        return list(source.batches())


def message(*submessages, prefix=PREFIX, version=(2, 5), vendor=b"\x01\x10"):
    """Return an RTPS message."""
    return RTPS_MAGIC + bytes(version) + vendor + prefix + b"".join(submessages)


def submessage(kind, body, flags=1, length=None):
    """Return a submessage; its length is that of its body unless another is given."""
    order = "<" if flags & 1 else ">"
    return struct.pack(f"{order}BBH", kind, flags, len(body) if length is None else length) + body


def made(kind, flags=1, tail=b"", **values):
    """Return a submessage of a kind with a layout; a sequence number is one value."""
    layout = SUBMESSAGE_LAYOUTS[kind].of(little=bool(flags & 1))
    words = {}
    for name, value in values.items():
        if f"{name}_high" in layout.by_name:
            words |= {f"{name}_high": value >> 32, f"{name}_low": value & 0xFFFFFFFF}
        else:
            words[name] = value
    ends = {"reader_id": READER, "writer_id": WRITER}
    words = {name: value for name, value in ends.items() if name in layout.by_name} | words
    raw = layout.emit(words)
    return submessage(kind, raw[4:] + tail, flags)


def data(number, payload, flags=5, inline=b"", **values):
    """Return a DATA with a payload."""
    flags |= 2 * bool(inline)
    return made(
        SubmessageKind.DATA, flags, inline + payload, writer_sn=number, octets_to_inline_qos=16, **values
    )


def parameter(number, value, order="<"):
    """Return a parameter, padded."""
    value += bytes(-len(value) % 4)
    return struct.pack(f"{order}HH", number, len(value)) + value


def text(value, order="<"):
    """Return a CDR string."""
    raw = value.encode() + b"\0"
    return struct.pack(f"{order}I", len(raw)) + raw


def announcement(topic, type_name, guid=PREFIX + WRITER, *, reliable=True, order="<", shared=False):
    """Return the data by which a writer is announced; ``shared`` through the memory of its host."""
    kind = 2 if reliable else 1
    parts = [
        parameter(0x005A, guid, order),
        parameter(0x0005, text(topic, order), order),
        parameter(0x0007, text(type_name, order), order),
        parameter(0x001A, struct.pack(f"{order}IiI", kind, 0, 0), order),
        *([parameter(0x002F, struct.pack(f"{order}iI", 16, 7413) + bytes(16), order)] if shared else ()),
        struct.pack(f"{order}HH", 1, 0),
    ]
    return (b"\0\3" if order == "<" else b"\0\2") + b"\0\0" + b"".join(parts)


def announced(topic="rt/cmd_vel", type_name=TWIST, **options):
    """Return the message that announces a writer."""
    return message(data(1, announcement(topic, type_name, **options), writer_id=bytes.fromhex("000003c2")))


def buffer(*payloads):
    """Return payloads in one buffer, with the offsets and lengths that readers take."""
    length = np.array([len(item) for item in payloads], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    return np.frombuffer(b"".join(payloads), np.uint8), offset, length
