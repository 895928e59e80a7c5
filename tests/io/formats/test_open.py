from __future__ import annotations

import gzip
import os
import random
import struct
import subprocess
import sys
import threading
from contextlib import closing

import pytest
import zstandard
from captures import read
from hypothesis import given
from hypothesis import strategies as st
from places import CAPTURES
from waiting import PATIENCE_S

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats import capture_file
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings

ROVER = (CAPTURES / "a_rover.pcap").read_bytes()


EXPECTED = read(CAPTURES / "a_rover.pcap")[0]


def gzipped(data):
    return gzip.compress(data, 1)


def zstandarded(data):
    return zstandard.compress(data, 1)


@pytest.mark.parametrize("pack", [gzipped, zstandarded])
def test_compressed_captures_are_told_by_content(tmp_path, pack):
    path = tmp_path / "misleading.txt"
    path.write_bytes(pack(ROVER))
    with closing(open_file(path)) as source:
        assert [row for batch in source.batches() for row in batch] == EXPECTED
        assert source.statistics.position == source.statistics.total_bytes == path.stat().st_size
        assert source.info.kind == "pcap"


@pytest.mark.parametrize("pack", [gzipped, zstandarded])
def test_several_members_are_one_stream(tmp_path, pack):
    path = tmp_path / "a"
    parts = [ROVER[start : start + 50_001] for start in range(0, len(ROVER), 50_001)]
    path.write_bytes(b"".join(map(pack, parts)))
    assert read(path) == (EXPECTED, "")


def test_zeros_behind_gzip_data_are_passed_over(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(gzipped(ROVER) + bytes(10_000))
    assert read(path) == (EXPECTED, "")


@pytest.mark.parametrize(("pack", "kind"), [(gzipped, "gzip"), (zstandarded, "zstd")])
@pytest.mark.parametrize("kept", [0.5, 0.9, 0.9999])
def test_compressed_and_cut(tmp_path, pack, kind, kept):
    path = tmp_path / "a"
    noise = random.Random(1).randbytes(400_000)
    content = struct.pack("<IIIIII", 0xA1B2C3D4, 0x40002, 0, 0, 65535, 1)
    content += b"".join(
        struct.pack("<IIII", 1, 0, 400, 400) + noise[at : at + 400] for at in range(0, 400_000, 400)
    )
    whole = pack(content)
    path.write_bytes(whole[: int(len(whole) * kept)])
    with closing(open_file(path)) as source:
        with pytest.raises(
            CaptureError, match=f"{path}: the {kind} data ends early; it was probably cut off"
        ):
            list(source.batches())
        assert source.statistics.frames >= 1000 * kept * 0.5


@pytest.mark.parametrize(("pack", "kind"), [(gzipped, "gzip"), (zstandarded, "zstd")])
def test_compressed_and_corrupt(tmp_path, pack, kind):
    path = tmp_path / "a"
    whole = bytearray(pack(ROVER))
    whole[-1500:-1400] = bytes(range(100))
    path.write_bytes(whole)
    rows, error = read(path)
    assert f"the {kind} data is corrupt" in error
    assert rows == EXPECTED[: len(rows)]


@given(st.binary(max_size=200), st.sampled_from(["", "gzip", "zstd"]), st.integers(0, 60))
def test_any_bytes_end_in_rows_or_in_one_clear_line(tmp_path_factory, content, kind, kept):
    heads = {"": b"", "gzip": gzipped(ROVER[:5000]), "zstd": zstandarded(ROVER[:5000])}
    path = tmp_path_factory.mktemp("any") / "a"
    path.write_bytes(heads[kind][: kept * 20] + content)
    try:
        error = read(path)[1]
    except CaptureError as raised:
        error = str(raised)
    assert not error or error.startswith(f"{path}: ")
    assert "\n" not in error


NOT_CAPTURES = {
    "is empty": b"",
    "looks like text; pcap, pcapng and MCAP can be read": b"number,time\n1,2\n",
    "looks like a Microsoft Network Monitor capture": b"GMBU\x02\x00",
    "looks like a snoop capture": b"snoop\x00\x00\x00\x00\x00\x00\x02",
    "looks like a zip archive": b"PK\x03\x04....",
    "editcap -F pcapng IN OUT": b"\xa1\xb2\xcd\x34" + bytes(40),
    "is not a capture (it starts with 00 01 02 03 04 05 06 07)": bytes(range(30)),
    "gzip data that contains text": gzipped(b"hello, this is text"),
    "zstd data that contains a zip archive": zstandarded(b"PK\x03\x04...."),
    "gzip data that contains gzip data again; unpack it once": gzipped(gzipped(b"x")),
    "contains only an empty gzip stream": gzipped(b""),
    "the gzip data ends early": gzipped(ROVER)[:12],
    "ends after 2 bytes, before its format can be recognised": b"\xd4\xc3",
}


@pytest.mark.parametrize("what", NOT_CAPTURES)
def test_what_is_no_capture_is_called_by_its_name(tmp_path, what):
    path = tmp_path / "a.pcap"
    path.write_bytes(NOT_CAPTURES[what])
    with pytest.raises(CaptureError) as caught:
        open_file(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert what in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.each(2)
@pytest.mark.quick("pipe", "zstd")
@pytest.mark.parametrize("way", ["pipe", "gzip", "zstd"])
def test_a_recording_from_a_pipe_or_packed_is_read_from_a_copy(tmp_path, monkeypatch, way):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    made, path = tmp_path / "a.mcap", tmp_path / "b"
    record(open_file(CAPTURES / "a_rover.pcap"), Settings().workbench(), Target(made))
    data = made.read_bytes()
    if way == "pipe":
        os.mkfifo(path)
        writer = threading.Thread(target=path.write_bytes, args=(data,))
        writer.start()
    else:
        path.write_bytes({"gzip": gzipped, "zstd": zstandarded}[way](data))
    with closing(open_file(path)) as source:
        assert source.info.name == str(path)
        assert [row for batch in source.batches() for row in batch] == EXPECTED
    if way == "pipe":
        writer.join(PATIENCE_S)
    assert list((tmp_path / "temporary").iterdir()) == []


def test_what_cannot_be_opened(tmp_path):
    with pytest.raises(CaptureError, match=r"missing\.pcap: there is no such file; check the name"):
        open_file(tmp_path / "missing.pcap")
    with pytest.raises(CaptureError, match="is a directory; name a capture in it"):
        open_file(tmp_path)
    with pytest.raises(CaptureError, match="cannot be opened"):
        open_file("a\0b")
    with pytest.raises(CaptureError, match="cannot be opened"):
        open_file(tmp_path / ("x" * 300))


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("edoras_tools.io.formats.open.io.FileIO", refuse)
    with pytest.raises(CaptureError, match="may not be read by this user; check its permissions"):
        open_file(tmp_path / "a")


def test_memory_stays_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(capture_file, "SLICE", 20_000)
    monkeypatch.setattr(capture_file, "FIRST", 1000)
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        sizes = [batch.data.size for batch in source.batches()]
    assert sizes[0] < 1200
    assert len(sizes) > 10
    assert max(sizes) < 21_000


@pytest.mark.each(2)
@pytest.mark.quick("bytes", "gzipped")
@pytest.mark.parametrize("pack", [bytes, gzipped, zstandarded])
def test_standard_input(pack):
    code = (
        "from edoras_tools.io.formats.open import open_file\n"
        "source = open_file('-')\n"
        "print(source.info.name, sum(len(batch) for batch in source.batches()))"
    )
    done = subprocess.run([sys.executable, "-c", code], input=pack(ROVER), capture_output=True, check=False)
    assert (done.stdout, done.stderr) == (f"- {len(EXPECTED)}\n".encode(), b"")


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_growing_pipe_hands_over_what_is_there(tmp_path, wrapped):
    """The writer waits for the reader to hand over what was written: the reader must not wait for more."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    handed_over = threading.Semaphore(0)
    step = 10_000
    failures = []

    def write():
        compressor = zstandard.ZstdCompressor().compressobj() if wrapped else None
        with path.open("wb", buffering=0) as pipe:
            for start in range(0, len(ROVER), step):
                part = ROVER[start : start + step]
                if compressor is not None:
                    part = compressor.compress(part) + compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
                pipe.write(part)
                if not handed_over.acquire(timeout=PATIENCE_S):
                    failures.append(start)
                    return
            if compressor is not None:
                pipe.write(compressor.flush())

    writer = threading.Thread(target=write)
    writer.start()
    rows = []
    with closing(open_file(path)) as source:
        for batch in source.batches():
            rows += list(batch)
            handed_over.release()
    writer.join()
    assert not failures
    assert rows == EXPECTED
