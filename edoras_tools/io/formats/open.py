"""Opens a capture by its content, not by its name."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from pathlib import Path
from socket import if_nameindex
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError, NoDatagramsError, OnFailure
from edoras_tools.io.formats import capture_file, table
from edoras_tools.io.formats.pcap import MAGICS, PcapSource
from edoras_tools.wire.cfe import CFE_MAGIC

if TYPE_CHECKING:
    from edoras_tools.io import Source

_SECTION_HEADER = b"\x0a\x0d\x0d\x0a"
_MCAP = b"\x89MCAP0\r\n"
_DATABASE = b"SQLite f"
"""First bytes of a SQLite file: rosbag2's ``.db3`` storage."""
_COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
_MODIFIED_PCAP = {b"\x34\xcd\xb2\xa1", b"\xa1\xb2\xcd\x34"}
_OTHERS = (
    (b"GMBU", "a Microsoft Network Monitor capture"),
    (b"RTSS", "a Microsoft Network Monitor capture"),
    (b"snoop\x00\x00\x00", "a snoop capture"),
    (b"#ROSBAG", "a ROS 1 bag"),
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "bzip2 data"),
    (b"\xfd7zXZ\x00", "xz data"),
    (b"\x7fELF", "a program"),
)
"""First bytes of other files that users may try to open, and what those files are."""
_CONVERT = "captures can be made readable with: editcap -F pcapng IN OUT"


def open_file(path: str | Path, name: str = "") -> Source:
    """Open a capture or a recording by its content: pcap, pcapng or MCAP, perhaps with gzip or zstd.

    Args:
        path: a file, a named pipe, a rosbag2 directory, or ``-`` for standard input.
        name: the name in messages; by default the path.

    Raises:
        CaptureError: ``path`` cannot be read.
        NoDatagramsError: it is a recording of another tool, with topics only.
    """
    try:
        if os.path.isdir(path):  # noqa: PTH112  Path raises an error at a name that no file can have
            return _open_folder(Path(path))
        file = capture_file.FileStream(_open(path), name or str(path))
        with OnFailure(file.close):
            stream, head, wrapped = _unpacked(file)
            return _source(stream, path, head, wrapped)
    except NoDatagramsError as error:
        error.path = str(path)
        raise


def _open_folder(path: Path) -> Source:
    from edoras_tools.io.formats.rosbag2.reader import open_folder

    source = open_folder(path, open_file)
    if source is None and (path / "metadata.yaml").exists():
        raise CaptureError(f"{path}: the files that its metadata.yaml names are not there")
    if source is None:
        raise CaptureError(f"{path}: is a directory; name a capture in it, or a rosbag2 directory")
    return source


def is_cfe_file(path: Path) -> bool:
    """Return whether a regular file was written by cFE, so that its times are mission times."""
    if not path.is_file():
        return False
    with suppress(OSError), path.open("rb") as file:
        return file.read(len(CFE_MAGIC)) == CFE_MAGIC
    return False


def _unpacked(file: capture_file.FileStream) -> tuple[capture_file.ByteStream, bytes, str]:
    """Return the stream inside of gzip or zstd, its first bytes, which are read, and the compression."""
    head = _head(file)
    kind = next((kind for magic, kind in _COMPRESSED.items() if head.startswith(magic)), "")
    if not kind:
        return file, head, ""
    stream = capture_file.CompressedStream(file, kind, head)
    return stream, _head(stream), kind


def _source(stream: capture_file.ByteStream, path: str | Path, head: bytes, wrapped: str) -> Source:
    """Make the source of a stream; ``head`` is its first bytes, ``wrapped`` the compression it had."""
    whole_file = stream.total_bytes and not wrapped and str(path) != "-"  # as a file of that name
    if not head:
        problem = f"contains only an empty {wrapped} stream" if wrapped else "is empty"
        raise CaptureError(f"{stream.name}: {problem}; a capture has at least a header")
    if head[:4] in MAGICS:
        return PcapSource(capture_file.Window(stream, head))
    if head.startswith(_SECTION_HEADER):
        return table.PCAPNG.source()(capture_file.Window(stream, head))
    if head.startswith(CFE_MAGIC):
        return table.CFE.source()(capture_file.Window(stream, head))
    if head.startswith(_MCAP):
        return _mcap(stream, path, b"" if whole_file else head)
    if head.startswith(_DATABASE):
        raise _database(stream, path, b"" if whole_file else head)
    for item in table.installed_formats():
        if item.magic and head.startswith(item.magic):
            return item.source()(capture_file.Window(stream, head))
    raise CaptureError(f"{stream.name}: {_looks_like(head, wrapped)}")


def kept_recording(path: Path) -> capture_file.SettledFile | Source:
    """Return a recording from a pipe as a file that can be opened again, and a capture as a source.

    Raises:
        CaptureError: it cannot be read.
    """
    stream, head = unwrapped(path)
    if head.startswith((_MCAP, _DATABASE)):
        return capture_file.settled_file(stream, path, head)
    with OnFailure(stream.close):
        return _source(stream, path, head, "")


def unwrapped(path: Path) -> tuple[capture_file.ByteStream, bytes]:
    """Open a file or pipe; return its decompressed stream, and the first bytes, which are already read.

    Raises:
        CaptureError: it cannot be read.
    """
    file = capture_file.FileStream(_open(path), str(path))
    with OnFailure(file.close):
        stream, head, _ = _unpacked(file)
    return stream, head


def _mcap(stream: capture_file.ByteStream, path: str | Path, head: bytes) -> Source:
    """Open a recording; standard input and compressed data are copied first: the index is at the end.

    ``head`` is the bytes already read of a stream that has to be copied; else empty.
    """
    file = capture_file.settled_file(stream, Path(path), head)
    try:
        source: Source = table.MCAP.source()(file.path, file.name, file.copy)
    except NoDatagramsError as error:
        error.files = [file]
        raise
    return source


def _database(stream: capture_file.ByteStream, path: str | Path, head: bytes) -> NoDatagramsError:
    """Return the error for a database, which has no datagrams; ``head`` is as for ``_mcap``."""
    error = NoDatagramsError(
        f"{stream.name}: a database holds topics and no datagrams; {table.TOPIC_READERS}"
    )
    error.files = [capture_file.settled_file(stream, Path(path), head)]
    return error


def _open(path: str | Path) -> io.FileIO:
    if str(path) == "-":
        try:
            # A duplicate, so that closing the source does not close standard input.
            return io.FileIO(os.dup(sys.stdin.fileno()), "rb")
        except (AttributeError, OSError, ValueError) as error:
            raise CaptureError("-: there is no standard input; name a file") from error
    try:
        return io.FileIO(path, "rb")
    except FileNotFoundError as error:
        live = str(path) in {name for _, name in if_nameindex()}
        hint = f"for live traffic: -i {path}" if live else "check the name"
        raise CaptureError(f"{path}: there is no such file; {hint}") from error
    except PermissionError as error:
        raise CaptureError(f"{path}: may not be read by this user; check its permissions") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CaptureError(f"{path}: cannot be opened: {reason}") from error


def _head(stream: capture_file.ByteStream) -> bytes:
    """Read the bytes of the longest magic number; fewer at the end of the stream."""
    buffer = bytearray(table.LONGEST_MAGIC)
    filled = 0
    while filled < table.LONGEST_MAGIC and (count := stream.fill(memoryview(buffer)[filled:])):
        filled += count
    return bytes(buffer[:filled])


def _looks_like(head: bytes, wrapped: str) -> str:
    """Return what a file that is not a capture probably is, and what to do."""
    inside = f"{wrapped} data that contains " if wrapped else "looks like "
    can = f"{table.READABLE} can be read"
    if head[:4] in _MODIFIED_PCAP:
        return f"a modified pcap (magic {head[:4].hex()}), whose records differ from file to file; {_CONVERT}"
    for magic, likely in _OTHERS:
        if head.startswith(magic):
            return f"{inside}{likely}; {can}; {_CONVERT}"
    if len(head) < 4:
        return f"ends after {len(head)} bytes, before its format can be recognised; {can}"
    for magic, kind in _COMPRESSED.items():
        if head.startswith(magic):
            return f"{inside}{kind} data again; unpack it once"
    if all(byte in b"\t\n\r\x1b" or 32 <= byte < 127 for byte in head):
        return f"{inside}text; {can}"
    return f"is not a capture (it starts with {head.hex(' ')}); {can}"
