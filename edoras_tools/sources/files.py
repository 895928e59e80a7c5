"""Opening a capture by what it holds, not by what it is called."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.sources.pcap import MAGICS, PcapSource
from edoras_tools.sources.stream import CompressedStream, FileStream, Stream, Window

if TYPE_CHECKING:
    from edoras_tools.sources import Source

_SECTION_HEADER = b"\x0a\x0d\x0d\x0a"
_MCAP = b"\x89MCAP0\r\n"
_COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
_LONGEST_MAGIC = 8
_MODIFIED_PCAP = {b"\x34\xcd\xb2\xa1", b"\xa1\xb2\xcd\x34"}
_OTHERS = (
    (b"GMBU", "a Microsoft Network Monitor capture"),
    (b"RTSS", "a Microsoft Network Monitor capture"),
    (b"snoop\x00\x00\x00", "a snoop capture"),
    (b"#ROSBAG", "a ROS 1 bag"),
    (b"SQLite f", "an SQLite database (perhaps a rosbag2 one)"),
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "bzip2 data"),
    (b"\xfd7zXZ\x00", "xz data"),
    (b"\x7fELF", "a program"),
)
"""How files start that people may take for captures."""
_CONVERT = "captures can be made readable with: editcap -F pcapng IN OUT"


def open_capture(path: str | Path) -> Source:
    """Open a capture or a recording; see ``edoras_tools.sources.open_file``."""
    name = str(path)
    stream: Stream = FileStream(_open(path), name)
    try:
        return _tell(stream, path)
    except BaseException:
        stream.close()
        raise


def _tell(stream: Stream, path: str | Path) -> Source:
    """Make the source that the first bytes ask for."""
    head = _head(stream)
    wrapped = ""
    for magic, kind in _COMPRESSED.items():
        if head.startswith(magic):
            wrapped = kind
            stream = CompressedStream(stream, kind, head)
            head = _head(stream)
            break
    if not head:
        what = f"holds nothing but an empty {wrapped} stream" if wrapped else "is empty"
        raise CaptureError(f"{stream.name}: {what}; a capture has at least a header")
    if head[:4] in MAGICS:
        return PcapSource(Window(stream, head))
    if head.startswith(_SECTION_HEADER):
        from edoras_tools.sources.pcapng import PcapngSource

        return PcapngSource(Window(stream, head))
    if head.startswith(_MCAP):
        return _mcap(stream, path, wrapped)
    raise CaptureError(f"{stream.name}: {_looks_like(head, wrapped)}")


def _mcap(stream: Stream, path: str | Path, wrapped: str) -> Source:
    if wrapped or not stream.total_bytes:
        where = f"inside {wrapped} data" if wrapped else "from a pipe"
        raise CaptureError(
            f"{stream.name}: an MCAP recording cannot be read {where}; make it a plain file first"
        )
    stream.close()
    from edoras_tools.sources.mcap import McapSource

    return McapSource(Path(path))


def _open(path: str | Path) -> io.FileIO:
    if str(path) == "-":
        try:
            # A duplicate, so that closing the source leaves standard input to its owner.
            return io.FileIO(os.dup(sys.stdin.fileno()), "rb")
        except (AttributeError, OSError, ValueError) as error:
            raise CaptureError("-: there is no standard input; name a file") from error
    try:
        return io.FileIO(path, "rb")
    except FileNotFoundError as error:
        raise CaptureError(f"{path}: there is no such file; check the name") from error
    except IsADirectoryError as error:
        raise CaptureError(f"{path}: is a directory; name a capture in it") from error
    except PermissionError as error:
        raise CaptureError(f"{path}: may not be read by this user; check its permissions") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CaptureError(f"{path}: cannot be opened: {reason}") from error


def _head(stream: Stream) -> bytes:
    """Read as much as the longest magic number needs, less at the end of the stream."""
    buffer = bytearray(_LONGEST_MAGIC)
    filled = 0
    while filled < _LONGEST_MAGIC and (count := stream.fill(memoryview(buffer)[filled:])):
        filled += count
    return bytes(buffer[:filled])


def _looks_like(head: bytes, wrapped: str) -> str:
    """Say what a file that is no capture seems to be, and what to do."""
    inside = f"{wrapped} data that holds " if wrapped else "looks like "
    can = "pcap, pcapng and MCAP can be read"
    if head[:4] in _MODIFIED_PCAP:
        return f"a modified pcap (magic {head[:4].hex()}), whose records differ from file to file; {_CONVERT}"
    for magic, what in _OTHERS:
        if head.startswith(magic):
            return f"{inside}{what}; {can}; {_CONVERT}"
    if len(head) < 4:
        return f"ends after {len(head)} bytes, before it could be told what it is; {can}"
    for magic, kind in _COMPRESSED.items():
        if head.startswith(magic):
            return f"{inside}{kind} data once more; unpack it once"
    if all(byte in b"\t\n\r\x1b" or 32 <= byte < 127 for byte in head):
        return f"{inside}text; {can}"
    return f"is no capture (it starts with {head.hex(' ')}); {can}"
