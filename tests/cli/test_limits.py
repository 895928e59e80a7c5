"""Where the system gives no more memory, files or room, a command ends with one line and exit code 1."""

from __future__ import annotations

import random
import resource
import struct
from functools import partial

import pytest
from effort import LONG, every
from waiting import free_ports

from edoras_tools.cli import main

MIB = 1 << 20


@pytest.fixture
def limited(edoras):
    """A function: run the command under a limit; check that it ends well, or in one line; return its code."""

    def run(limit, value, *arguments):
        set_it = partial(resource.setrlimit, limit, (value, value))
        done = edoras(*arguments, preexec_fn=set_it)
        told = done.stderr.decode()
        if done.returncode == 1:
            lines = [
                line for line in told.splitlines() if line.startswith(("edoras: ", "OpenBLAS error: Memory"))
            ]
            assert len(lines) == 1, told
        else:
            assert done.returncode in {0, 3}, told
        assert "Traceback" not in told
        return done.returncode, told

    return run


@pytest.mark.quick("record")
@pytest.mark.parametrize("kind", ["doctor", "record", "listen"])
def test_memory(limited, captures, missions, tmp_path, kind):
    capture, rover = captures("a_rover"), missions("rover_ground")
    words = {
        "doctor": ["doctor", capture, *rover],
        "record": ["record", "-r", capture, *rover, "-o", tmp_path / "x.mcap", "--force"],
        "listen": ["record", "--listen", 0, "--duration", "0.1", "-o", tmp_path / "y.mcap", "--force"],
    }[kind]
    ends = [limited(resource.RLIMIT_AS, size * MIB, *words) for size in every(4, (50, 100, 115, 130, 4000))]
    assert ends[-1][0] in {0, 3}
    assert any("out of memory" in told or "OpenBLAS" in told for _, told in ends)


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.mcap", "x.pcap", "x.pcapng"])
def test_the_size_of_a_file(limited, captures, tmp_path, name):
    words = ["record", "-r", captures("a_rover"), "-o", tmp_path / name]
    code, told = limited(resource.RLIMIT_FSIZE, 8192, *words)
    assert (code, "File too large" in told) == (1, True)


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.mcap", "x.pcap", "x.pcapng"])
def test_nothing_is_left_where_nothing_can_be_written(limited, captures, tmp_path, name):
    """A service is started again and again while the disk is full."""
    code, told = limited(resource.RLIMIT_FSIZE, 0, "record", "-r", captures("a_rover"), "-o", tmp_path / name)
    assert (code, list(tmp_path.iterdir())) == (1, [])
    assert f"{name}: cannot be written: File too large; name another file with -o or make room" in told


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ["plot", "a.pcap", "/cmd_vel.linear.x", "-o", "new.html"],
        ["report", "a.pcap", "-o", "new.html"],
        ["check", "--init", "a.pcap", "-o", "new.yaml"],
        ["mission", "draft", "a.pcap", "-o", "new.yaml"],
        ["export", "a.pcap", "--topic", "/cmd_vel", "-o", "new.csv"],
        ["codegen", "geometry_msgs", "-o", "new"],
        ["samples", "new"],
    ],
    ids=lambda words: words[0],
)
def test_no_part_of_a_file_is_left_where_there_is_no_room(
    limited, captures, missions, tmp_path, monkeypatch, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pcap").symlink_to(captures("a_rover"))
    given = [*words, *(() if words[0] in {"codegen", "mission", "samples"} else missions("rover_ground"))]
    code, told = limited(resource.RLIMIT_FSIZE, 300, *given)
    assert code == 1
    assert "cannot be written: File too large" in told
    assert [path for path in tmp_path.rglob("new*") if path.is_file()] == []


@pytest.mark.long
def test_open_files(limited, missions):
    (port,) = free_ports(1)
    listen = ["record", "--listen", port, "--duration", "0.1", "-o", "/dev/null/x.mcap"]
    show = ["live", "--sim", "rover", "--duration", "0.1", "--ws-port", 0]
    told = [
        limited(resource.RLIMIT_NOFILE, count, *words)[1]
        for count in (range(5, 9) if LONG else (6,))
        for words in (listen, show, ["sniff", "--listen", port, "--duration", "0.1"])
    ]
    assert any("too many open files: " in item for item in told)


def garbled(path, share):
    """A classic pcap with random times on some packets."""
    numbers, data = random.Random(1), path.read_bytes()
    made, place = bytearray(data[:24]), 24
    while place < len(data):
        head = list(struct.unpack_from("<IIII", data, place))
        if numbers.random() < share:
            head[:2] = numbers.randrange(1 << 32), numbers.randrange(1 << 32)
        made += struct.pack("<IIII", *head) + data[place + 16 : place + 16 + head[2]]
        place += 16 + head[2]
    return bytes(made)


@pytest.mark.long
@pytest.mark.parametrize(("share", "command"), [(0.05, "doctor"), (1, "doctor"), (1, "report")])
def test_garbled_times_are_no_reason_for_memory(limited, captures, missions, tmp_path, share, command):
    """Between two of them lie up to 136 years; a number for each second would be 32 GiB."""
    path = tmp_path / "garbled.pcap"
    path.write_bytes(garbled(captures("a_rover"), share))
    more = ["-o", tmp_path / "x.html"] if command == "report" else []
    assert limited(resource.RLIMIT_AS, 1000 * MIB, command, path, *missions("rover_ground"), *more)[0] == 3


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ["info"],
        ["plot", "-o", "x.svg"],
        ["export", "--topic", "/cmd_vel", "-o", "x.csv"],
        ["record", "-o", "x.mcap"],
    ],
    ids=lambda words: words[0],
)
def test_a_clock_that_was_not_set_for_every_second_packet(
    limited, captures, missions, tmp_path, monkeypatch, words
):
    monkeypatch.chdir(tmp_path)
    data = bytearray(captures("a_rover").read_bytes())
    place, odd = 24, False
    while place < len(data):
        seconds, _, length = struct.unpack_from("<3I", data, place)
        if odd:
            struct.pack_into("<I", data, place, seconds - 1_795_000_000)
        place, odd = place + 16 + length, not odd
    (tmp_path / "mixed.pcap").write_bytes(data)
    code, told = limited(resource.RLIMIT_AS, 1000 * MIB, *words, "mixed.pcap", *missions("rover_ground"))
    assert code == 0
    assert told.count("some times are before the year 2000 and others are not") == 1


@pytest.mark.parametrize(
    "told", ["error return without exception set", "<built-in> returned NULL without setting an exception"]
)
def test_python_without_memory_for_its_own_error(told):
    assert main._limit(SystemError(told)).startswith("out of memory")
    assert main._limit(SystemError("a mistake")) == ""


def test_what_comes_of_a_lack_of_memory():
    error = ImportError("numpy could not be imported")
    error.__context__ = MemoryError()
    assert main._limit(error).startswith("out of memory")
