"""Outputs that are taken away while commands write them, and a second recorder on the same one."""

import json
import re
import resource
import shutil
import socket
import struct
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from waiting import Ear, Program, until

from edoras_tools.words import plural

HEADER = bytes.fromhex("1827 0000 0045 01 00") + struct.pack("<QQ", 52, 52) + bytes.fromhex("00010000")
PACKET = HEADER + bytes(48)


def recorder(command, path, *options):
    """A recorder that listens, and a socket towards it."""
    program = Program(command, "record", "--listen", "127.0.0.1:0", "-o", path, *options)
    host, _, port = program.line(program.err).split()[2].rstrip(";").rpartition(":")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect((host, int(port)))
    return program, sender


def some(program, sender, path):
    """Send some, and wait until they are in the file."""
    before = path.stat().st_size

    def grown():
        sender.send(PACKET)
        return path.stat().st_size > before

    program.until(grown)


def delete(path):
    path.unlink()


def move(path):
    path.rename(path.with_name("moved" + path.suffix))


def replace(path):
    other = path.with_name(f"other{path.suffix}")
    shutil.copy(path, other)
    other.rename(path)


def truncate(path):
    path.write_bytes(b"")


@pytest.mark.quick("move-moved to")
@pytest.mark.parametrize(
    ("how", "fate"),
    [(delete, "deleted"), (move, "moved to"), (replace, "replaced by another file"), (truncate, "truncated")],
)
def test_record_goes_on_beside(command, call, how, fate, tmp_path):
    """In each format, by recorders beside each other: most of the time they wait."""

    def watched(suffix):
        path, beside = tmp_path / f"x{suffix}", tmp_path / f"x_1{suffix}"
        program, sender = recorder(command, path)
        with program, sender:
            port = f"--port=ci:{sender.getpeername()[1]}"
            some(program, sender, path)
            how(path)
            told = program.line(program.err)
            assert told.startswith(f"edoras: {path} was {fate}")
            assert told.endswith(f"; continuing in {beside}\n")
            until(beside.exists)
            some(program, sender, beside)
            return beside, told, program.end(code=3)[1], port

    suffixes = (".mcap", ".pcap", ".pcapng")
    with ThreadPoolExecutor(len(suffixes)) as threads:
        found = list(threads.map(watched, suffixes))
    for suffix, (beside, told, err, port) in zip(suffixes, found, strict=True):
        there = call("info", "--json", beside).json()["datagrams"]
        first, *_, second = err.splitlines()  # between them perhaps: the port looks like a link
        assert first.startswith(f"{beside}: {plural(there, 'datagram')} over ")
        assert second == told.strip().partition(";")[0]
        if how is move:
            kept = call("info", "--json", tmp_path / f"moved{suffix}", port)
            assert kept.code == 0
            assert re.search(rf"\b{kept.json()['datagrams']:,} datagrams? (is|are) there", second)


def test_nothing_is_claimed_of_a_file_that_is_not_there(command, tmp_path):
    path = tmp_path / "x.mcap"
    program, sender = recorder(command, path, "--json")
    with program, sender:
        some(program, sender, path)
        path.unlink()
        out, err = program.end(code=3)
    report = json.loads(out)
    lost = [line for line in report["warnings"] if "was deleted while it was written" in line]
    assert len(lost) == 1
    assert report["datagrams"] == 0
    assert lost[0] in err


def test_a_second_recorder_is_refused(command, call, tmp_path):
    path = tmp_path / "x.mcap"
    program, sender = recorder(command, path)
    with program, sender:
        some(program, sender, path)
        second = call("record", "--listen", "127.0.0.1:0", "-o", path, "--force")
        told = "cannot be created: another program is writing it; name another output"
        assert (second.code, second.err[-1]) == (1, f"edoras: {path}: {told}")
        port = f"--port=ci:{sender.getpeername()[1]}"
        program.end()
    assert call("info", path, port).code == 0


def test_the_proxy_tells_it_too(command, call, tmp_path):
    path = tmp_path / "x.mcap"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as target:
        target.bind(("127.0.0.1", 0))
        words = ["--listen", "127.0.0.1:0", "--target", f"127.0.0.1:{target.getsockname()[1]}"]
        with Program(command, "proxy", "ci", *words, "-o", path, "--yes") as program:
            program.line(program.err)
            until(path.exists)
            path.unlink()
            while "was deleted while it was written" not in (told := program.line(program.err)):
                pass
            assert told.endswith(f"; continuing in {tmp_path}/x_1.mcap\n")
            program.end(code=3)
    assert (tmp_path / "x_1.mcap").exists()


@pytest.mark.quick("replay")
@pytest.mark.parametrize("command_name", ["replay", "inject"])
def test_what_sends_tells_it_too(command, call, captures, command_name, tmp_path):
    """The rate leaves no time to write until the end; the file is looked at then."""
    path = tmp_path / "x.mcap"
    with Ear() as ear:
        what = {
            "replay": [captures("a_rover"), "--to", "ci", "--loop", 0],
            "inject": ["to-enable", "--hz", 50],
        }
        words = [*what[command_name], "--target", f"127.0.0.1:{ear.port}", "--no-listen", "--json"]
        with Program(command, command_name, *words, "-o", path) as program:
            program.until(ear.take, "it sends")
            path.unlink()
            out, err = program.end(code=3)
    told = f"{path} was deleted while it was written: "
    assert [line for line in json.loads(out)["notes"] if line.startswith(told)]
    assert err.splitlines()[-1].startswith(f"edoras: {told}")


@pytest.mark.long
def test_what_sends_and_cannot_write(edoras, captures, tmp_path):
    """As on a full disk."""
    with Ear() as ear:
        small = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (8192, 8192))
        words = ["--to", "ci", "--target", f"127.0.0.1:{ear.port}", "--no-listen", "--max", "-n", 200]
        done = edoras("replay", captures("a_rover"), *words, "-o", tmp_path / "x.pcap", preexec_fn=small)
    assert (done.returncode, b"cannot be written: File too large" in done.stderr) == (1, True)
