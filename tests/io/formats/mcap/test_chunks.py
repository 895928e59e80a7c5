"""Chunks that hold more than anybody has memory for: one line, at most 512 MiB, and what is before them."""

import resource
import struct
import subprocess
import sys

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Schema

from edoras_tools.io.formats.mcap.file import record_bytes
from edoras_tools.io.topics.messages import MAGIC

LIMIT = 512 << 20
HUGE = 2 << 30
SCHEMAS = record_bytes(
    Schema(id=1, data=b"string data\n", encoding="ros2msg", name="std_msgs/msg/String"),
    Channel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1),
)


def record(opcode, content, more=0):
    return struct.pack("<BQ", opcode, len(content) + more) + content


def chunk(compression, size, packed, length=None):
    length = len(packed) if length is None else length
    name = compression.encode()
    head = struct.pack("<QQQII", 1, 1, size, 0, len(name)) + name + struct.pack("<Q", length)
    return record(Opcode.CHUNK, head + packed, length - len(packed))


def message():
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 1, 1, 1) + b"\0\1\0\0\4\0\0\0abc\0")


def zeros(packer):
    return b"".join(packer.compress(bytes(1 << 24)) for _ in range(HUGE >> 24)) + packer.flush()


def zeros_zstd():
    return zeros(zstandard.ZstdCompressor(level=1).compressobj(size=HUGE))


def zeros_lz4():
    packer = lz4.frame.LZ4FrameCompressor()
    return packer.begin() + zeros(packer)


BOMBS = {
    "zstd": lambda: chunk("zstd", HUGE, zeros_zstd()),
    "zstd, a smaller size said": lambda: chunk("zstd", 1000, zeros_zstd()),
    "lz4": lambda: chunk("lz4", HUGE, zeros_lz4()),
    "sparse": lambda: chunk("", HUGE, b"", HUGE),
    "a sparse message": lambda: record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 1, 1, 1), HUGE),
    "many messages": lambda: chunk("zstd", 84 << 17, zstandard.compress(message() * (84 << 17 // 43))),
}


@pytest.mark.each(2)
@pytest.mark.quick("info-sparse", "recover-zstd")
@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("command", ["info", "recover"])
def test_a_bomb_costs_a_line_and_little_memory(command, name, tmp_path):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(
        MAGIC + record_bytes(Header("ros2", "x")) + SCHEMAS + chunk("", 43, message()) + BOMBS[name]()
    )
    if "sparse" in name:
        with path.open("r+b") as file:
            file.seek(HUGE, 2)
            file.write(record_bytes(Footer(0, 0, 0)) + MAGIC)
    options = ["-o", tmp_path / "made.mcap"] if command == "recover" else []
    done = subprocess.run(
        [sys.executable, "-m", "edoras_tools", command, path, *options],
        capture_output=True,
        check=False,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (LIMIT, LIMIT)),
        timeout=60,
    )
    said = done.stdout + done.stderr
    assert "Traceback" not in said, said
    assert "memory" not in said, said
    assert done.returncode in {1, 3}, said
    assert "/a" in done.stdout
