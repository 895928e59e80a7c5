"""Files cut off anywhere: all before the cut is kept, the cut is told in one line, the output is whole."""

import random
import re
import struct

import pytest
from effort import every

FRAMES = 40


@pytest.fixture(scope="module")
def whole(edoras, captures, frames, write_pcap, tmp_path_factory):
    """A short capture in every format, by suffix, and its frames."""
    folder = tmp_path_factory.mktemp("whole")
    chosen = frames(captures("a_rover"))[-FRAMES:]
    files = {".pcap": write_pcap(folder / "x.pcap", chosen)}
    for suffix in (".pcapng", ".mcap"):
        files[suffix] = folder / f"x{suffix}"
        assert edoras("record", "-q", "-r", files[".pcap"], "-o", files[suffix]).returncode == 0
    return {suffix: path.read_bytes() for suffix, path in files.items()}, chosen


def lengths(data, seed):
    """Every length within the first 200 bytes, and a few beyond; the last lacks at most a byte."""
    beyond = random.Random(seed).sample(range(200, len(data) - 1), 39)
    return [*every(13, range(200)), *sorted([*every(8, beyond), len(data) - 1])]


def pcap_records(data):
    """Where each record of a pcap ends."""
    place = 24
    while place < len(data):
        place += 16 + struct.unpack_from("<I", data, place + 8)[0]
        yield place


def pcapng_records(data):
    """Where each enhanced packet block of a little-endian pcapng ends."""
    place = 0
    while place < len(data):
        kind, length = struct.unpack_from("<II", data, place)
        place += length
        if kind == 6:
            yield place


@pytest.mark.each(2)
@pytest.mark.parametrize(("suffix", "ends"), [(".pcap", pcap_records), (".pcapng", pcapng_records)])
def test_cut_captures(suffix, ends, whole, call, frames, tmp_path):
    files, chosen = whole
    data = files[suffix]
    boundaries = list(ends(data))
    assert len(boundaries) == FRAMES
    cut, out = tmp_path / f"cut{suffix}", tmp_path / "out.pcap"
    for length in lengths(data, suffix):
        cut.write_bytes(data[:length])
        out.unlink(missing_ok=True)
        done = call("record", "-q", "-r", cut, "-o", out)
        there = sum(end <= length for end in boundaries)
        # Between two records nothing shows that there was more.
        sound = length in boundaries
        assert (done.code, len(done.err)) == ((0, 0) if sound else (1, 1)), (length, done.err)
        assert sound or done.err[0].startswith(f"edoras: {cut}: "), length
        assert there == 0 or frames(out) == chosen[:there], length


@pytest.mark.quick("*json-.mcap", "mission*")
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".mcap"])
@pytest.mark.parametrize(
    "command",
    [
        "sniff --stat routes",
        "sniff --stat routes --json",
        "sniff --sequence mermaid",
        "mission draft",
        "files",
    ],
)
def test_what_was_read_before_the_cut_is_reported(command, suffix, whole, call, tmp_path):
    data = whole[0][suffix]
    cut, full = tmp_path / f"cut{suffix}", tmp_path / f"full{suffix}"
    full.write_bytes(data)
    size = len(data) - 1 if suffix != ".mcap" else struct.unpack_from("<Q", data, len(data) - 28)[0] - 13
    cut.write_bytes(data[:size])
    done, good = (call(*command.split(), path) for path in (cut, full))
    assert (done.code, len(done.err)) == (1, 1), done.err
    assert ": cut" not in done.out.replace(str(cut), "")
    assert abs(len(done.out.splitlines()) - len(good.out.splitlines())) <= 1
    assert done.out.strip()


def test_a_recording_with_its_end_is_damaged_not_cut_off(whole, call, tmp_path):
    data, place = bytearray(whole[0][".mcap"]), 8
    while data[place] != 6:  # the first chunk
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    struct.pack_into("<Q", data, place + 1, 1 << 40)
    (tmp_path / "x.mcap").write_bytes(data)
    (line,) = call("info", tmp_path / "x.mcap").err
    assert f"is damaged at byte {place} of {len(data)}" in line


def test_cut_recordings(whole, call, frames, tmp_path):
    """Of a recording's chunk that is cut as much as decompresses may come back, in order and unharmed.

    Behind the end of the data there are only indexes: without them nothing is missing.
    """
    files, chosen = whole
    data = files[".mcap"]
    (summary_start,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.pcap"
    known = []
    for length in lengths(data, ".mcap"):
        cut.write_bytes(data[:length])
        out.unlink(missing_ok=True)
        done = call("record", "-q", "-r", cut, "-o", out)
        sound = length >= summary_start
        assert (done.code, len(done.err)) == ((0, 0) if sound else (1, 1)), (length, done.err)
        assert sound or done.err[0].startswith(f"edoras: {cut}: "), length
        kept = frames(out) if out.exists() else []
        assert kept == chosen[: len(kept)], length
        known.append(len(kept))
    assert known == sorted(known)
    assert (known[0], known[-1]) == (0, FRAMES)


@pytest.mark.each(3)
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".mcap"])
@pytest.mark.parametrize("command", ["sniff -a --json -r", "sniff -a -V -r", "info --json"])
def test_every_command_keeps_what_was_before_the_cut(command, suffix, whole, call, tmp_path):
    files, _ = whole
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(files[suffix][:-3])
    done = call(*command.split(), cut)
    # A recording that lacks its last bytes lacks no message.
    lost = 0 if suffix == ".mcap" else 1
    assert (done.code, len(done.err)) == (lost, lost)
    kept = list(range(1, FRAMES + 1 - lost))
    if "-V" in command:
        assert re.findall(r"^Packet (\d+) ", done.out, re.MULTILINE) == [str(number) for number in kept]
    elif "sniff" in command:
        assert [item["number"] for item in done.lines()] == kept
    else:
        assert done.json()["datagrams"] == len(kept)


def test_decode_finds_a_packet_before_the_cut(whole, call, tmp_path):
    files, _ = whole
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(files[".pcap"][:-3])
    assert call("decode", cut, FRAMES - 1).code == 0
    done = call("decode", cut, FRAMES)
    assert (done.code, len(done.err)) == (1, 1)
    assert "ends inside record 40" in done.err[0]


@pytest.mark.parametrize("length", [*range(0, 200, 7), 1000, 2000, -8, -1])
def test_recover_of_any_length(length, whole, call, recording, tmp_path):
    files, _ = whole
    data = files[".mcap"]
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(data[:length])
    done = call("recover", cut, "-o", out, "--json")
    if done.code == 0:
        assert done.err == []
        counts = recording(out).counts
        assert done.json()["messages"].get("/edoras/datagrams", 0) == counts.get("/edoras/datagrams", 0)
    else:
        assert (done.code, len(done.err)) == (1, 1)
        assert not out.exists()


def test_recover_brings_back_what_is_there(whole, call, recording, tmp_path):
    files, chosen = whole
    cut, out = tmp_path / "cut.mcap", tmp_path / "cut.recovered.mcap"
    cut.write_bytes(files[".mcap"][:-100])
    assert call("recover", cut).code == 0
    assert recording(out).counts["/edoras/datagrams"] == len(chosen)
    again = call("recover", out)
    assert (again.code, again.out.startswith("intact: ")) == (0, True)
