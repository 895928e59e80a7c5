"""Pipes and terminals: what comes in while it grows, what goes out when nobody, or nothing, can take it."""

import fcntl
import gzip
import json
import os
import pty
import re
import socket
import struct
import subprocess
import termios
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
import warm
import zstandard
from effort import every, long_but
from places import ROOT
from waiting import HOST, PATIENCE_S, Program, free_ports, until

ANSI = b"\x1b["


@pytest.fixture
def pipe(command):
    """A function: start a command with pipes for everything; its standard input takes bytes."""
    with ExitStack() as started:

        def run(*arguments, **options):
            program = started.enter_context(Program(command, *arguments, stdin=subprocess.PIPE, **options))
            return program, program.process.stdin.buffer

        yield run


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("name", "pack"), [("x.gz", gzip.compress), ("x.zst", zstandard.compress), ("x", bytes)]
)
@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_compressed_files_and_pipes_give_the_same(name, pack, kind, call, edoras, captures, tmp_path):
    plain = tmp_path / f"a.{kind}"
    assert call("record", "-q", "-r", captures("a_rover"), "-o", plain).code == 0
    packed = tmp_path / name
    packed.write_bytes(pack(plain.read_bytes()))
    wanted = captures("a_rover").read_bytes()
    assert call("record", "-q", "-r", packed, "-o", tmp_path / "file.pcap").code == 0
    assert (tmp_path / "file.pcap").read_bytes() == wanted
    if kind == "pcap":
        done = edoras("record", "-q", "-r", "-", "-o", tmp_path / "pipe.pcap", input=packed.read_bytes())
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
        assert (tmp_path / "pipe.pcap").read_bytes() == wanted


def test_a_growing_pipe_shows_its_packets_before_it_ends(pipe, captures, frames):
    data = captures("a_rover").read_bytes()
    sizes = [16 + len(frame) for _, frame, _ in frames(captures("a_rover"))]
    program, into = pipe("sniff", "-a", "-r", "-")
    into.write(data[:24])
    place, shown = 24, []
    for group in range(3):  # five packets each, then silence
        end = place + sum(sizes[5 * group : 5 * group + 5])
        into.write(data[place:end])
        into.flush()
        place = end
        while len(shown) < 1 + 5 * (group + 1):  # the heading and the packets so far
            shown.append(program.line())
    into.close()
    assert program.end(None) == ("", "")
    assert [int(line.split()[0]) for line in shown[1:]] == list(range(1, 16))


@pytest.mark.each(3)
@pytest.mark.parametrize("options", [["record", "-o", "x.mcap", "-r"], ["sniff", "-a", "-r"], ["info"]])
def test_ctrl_c_ends_a_pipe_that_says_nothing(options, pipe, captures, frames, call, tmp_path):
    """What came before is written or shown; the process does not wait for the pipe."""
    data = captures("a_rover").read_bytes()
    half = 24 + sum(16 + len(frame) for _, frame, _ in frames(captures("a_rover"))[:100])
    program, into = pipe(*options, "-", cwd=tmp_path)
    into.write(data[:half])
    into.flush()
    # It takes all, and waits for more, as it would for ever.
    program.until(lambda: not unread(into) and program.idle(), "it has taken what there is")
    out, err = program.end(code=130)
    assert "edoras: -: interrupted; everything before was read" in err
    match options[0]:
        case "record":
            assert "x.mcap: 100 datagrams" in err
            assert call("info", "--json", tmp_path / "x.mcap").json()["datagrams"] == 100
        case "sniff":
            assert len(out.splitlines()) == 101
        case _:
            assert "packets  100 datagrams" in out


def unread(stream):
    """Bytes that wait in a pipe."""
    return struct.unpack("i", fcntl.ioctl(stream.fileno(), termios.FIONREAD, bytes(4)))[0]


# In `make test` a half of them meets a reader that goes, the other half a full disk.
WRITERS = [
    ["sniff", "-r"],
    ["sniff", "-V", "-r"],
    ["sniff", "--json", "-r"],
    ["info"],
    ["info", "--json"],
    ["decode", "--json"],
]


@pytest.mark.quick("sniff -r")
@pytest.mark.parametrize("options", long_but(WRITERS[::2], WRITERS), ids=" ".join)
def test_head_is_no_error(options, command, captures):
    """``edoras ... | head -n 1``, which has gone long before the output ends."""
    after = " 2" if "decode" in options else ""
    line = (
        f"'{command}' {' '.join(options)} '{captures('a_rover')}'{after} | head -n 1; echo ${{PIPESTATUS[0]}}"
    )
    done = subprocess.run(["bash", "-c", line], capture_output=True, check=False, timeout=300)
    assert done.stdout.splitlines()[-1] == b"0"
    assert done.stderr == b""


@pytest.mark.long
@pytest.mark.parametrize("options", long_but(WRITERS[1::2], WRITERS), ids=" ".join)
def test_a_full_disk_is_one_line(options, command, captures):
    after = ["2"] if "decode" in options else []
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [command, *options, captures("a_rover"), *after], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 1
    told = "standard output cannot be written: No space left on device"
    if "--json" in options:
        assert json.loads(done.stderr)["error"] == {"code": "output", "message": told, "hint": None}
    else:
        assert done.stderr.decode() == f"edoras: {told}\n"


@pytest.mark.long
def test_closed_streams(command, captures):
    line = f"'{command}' {{}} '{captures('a_rover')}' {{}}; echo $? >&3"
    cases = [
        ("info", ">&-", b"0"),
        ("info", "2>&-", b"0"),
        ("info -c nowhere.yaml", "2>&-", b"2"),
        ("sniff -n 1 -r", ">&- 2>&-", b"0"),
    ]
    for options, closed, code in every(3, cases):
        script = f"exec 3>&1; {line.format(options, closed)}"
        done = subprocess.run(["bash", "-c", script], capture_output=True, check=False, timeout=300)
        assert done.stdout.splitlines()[-1] == code
        assert b"Traceback" not in done.stderr


@pytest.mark.long
def test_no_standard_input(command):
    done = subprocess.run(["bash", "-c", f"'{command}' info - <&-"], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
    assert done.stderr == b"edoras: -: there is no standard input; name a file\n"


def on_terminal(command, *arguments, **environment):
    """What a command writes to a terminal of 100 columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    plain = {
        key: value for key, value in os.environ.items() if key not in {"NO_COLOR", "FORCE_COLOR", "COLUMNS"}
    }
    process = warm.Popen(
        [command, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
        env={**plain, "TERM": "xterm-256color", **environment},
    )
    os.close(theirs)
    written = bytearray()
    try:
        while chunk := os.read(ours, 1 << 16):
            written += chunk
    except OSError:  # how Linux tells that the other end has gone
        pass
    os.close(ours)
    assert process.wait(PATIENCE_S) == 0
    return bytes(written)


@pytest.mark.long
def test_a_recorder_at_a_stopped_terminal_goes_on_writing(command, tmp_path):
    """Ctrl-S, or a remote shell that hangs: what comes meanwhile is in the file, killed or not."""
    ours, theirs = pty.openpty()
    drawn = []

    def read():
        try:
            while chunk := os.read(ours, 1 << 16):
                drawn.append(chunk)
        except OSError:  # the end
            os.close(ours)

    threading.Thread(target=read, daemon=True).start()
    path, (port,) = tmp_path / "x.mcap", free_ports(1)
    environment = {**os.environ, "TERM": "xterm-256color"}
    words = [command, "record", "--listen", f"{HOST}:{port}", "-o", str(path)]
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stderr=theirs, env=environment)
    try:
        until(lambda: b"waiting for the first packet" in b"".join(drawn))
        termios.tcflow(theirs, termios.TCOOFF)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for _ in range(8):  # two seconds, eight drawings
                before = path.stat().st_size

                def grown(before=before):
                    sender.sendto(bytes(100), (HOST, port))
                    return path.stat().st_size > before

                until(grown)
        seen = len(drawn)
        termios.tcflow(theirs, termios.TCOON)
        until(lambda: len(drawn) > seen)
        process.terminate()
        until(lambda: b"datagrams over" in b"".join(drawn))
    finally:
        process.kill()
        process.wait(PATIENCE_S)
    os.close(theirs)


def test_colours_are_for_terminals(command, edoras, captures, tmp_path):
    options = ["sniff", "-r", captures("e_ci_errors"), "-n", "60"]
    assert ANSI not in edoras(*options).stdout
    assert ANSI in on_terminal(command, *options)
    assert ANSI not in on_terminal(command, *options, NO_COLOR="1")
    assert ANSI in edoras(*options, env={**os.environ, "FORCE_COLOR": "1", "NO_COLOR": ""}).stdout


def test_lines_fit_their_terminal(command, captures):
    shown = on_terminal(command, "sniff", "-r", captures("a_rover"), "-n", "40", NO_COLOR="1").decode()
    assert max(map(len, shown.splitlines())) <= 100


def test_progress_is_for_terminals_and_leaves_its_line_behind(command, edoras, captures, tmp_path):
    options = ["record", "-r", captures("a_rover"), "-o", tmp_path / "x.mcap"]
    shown = on_terminal(command, *options)
    assert b"1,827 datagrams" in shown
    assert shown.count(b"\x1b[?25l") == shown.count(b"\x1b[?25h")  # the cursor comes back
    assert ANSI not in edoras(*options).stderr


@pytest.mark.long
def test_names_and_terminals_that_are_no_text(command, edoras, captures, recording, tmp_path):
    """A file name of any bytes, a terminal of ASCII only: shown, escaped, recorded and never an error."""
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.pcap"))
    odd.write_bytes(captures("a_rover").read_bytes())
    mission = odd.with_suffix(".yaml")
    mission.write_bytes((ROOT / "samples/missions/rover_ground.yaml").read_bytes())
    for options in (["info"], ["info", "--json"], ["sniff", "-n", "1", "-r"]):
        done = edoras(*options, odd)
        assert (done.returncode, done.stderr) == (0, b"")
    target = odd.with_suffix(".mcap")
    assert edoras("record", "-q", "-r", odd, "-c", mission, "-o", target).returncode == 0
    read = recording(target)
    assert read.metadata["edoras"]["source"].endswith("/\\udcff.pcap")
    assert list(read.attachments) == ["\\udcff.yaml"]
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [command, "sniff", "-n", "1", "-r", odd], capture_output=True, check=False, env=ascii_only
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert re.search(rb"127.0.0.1:2234 \\u2192 127.0.0.1:2235", done.stdout)
