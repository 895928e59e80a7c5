"""Live capture through the commands: on loopback, this process being the bridge; CAP_NET_RAW for ``-i``."""

import contextlib
import json
import random
import shutil
import signal
import socket
import struct
from contextlib import ExitStack

import pytest
from places import MISSIONS
from waiting import Program

HEADER = bytes.fromhex("1827 0000 0045 01 00") + struct.pack("<QQ", 52, 52) + bytes.fromhex("00010000")


GROUND = ("-c", MISSIONS / "rover_ground.yaml")


def twist(number):
    """A command as the ground bridge sends it; its number is the speed."""
    return HEADER + struct.pack("<6d", number, 0, 0, 0, 0, 0)


def numbers(messages):
    """The numbers of recorded Twists."""
    return [int(struct.unpack_from("<d", message.data, 4)[0]) for message in messages]


@pytest.fixture
def link():
    """A function that sends datagrams, and the port that they go to: CI's."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 1234))
        sender.connect(receiver.getsockname())
        yield sender.send, receiver.getsockname()[1]


@pytest.fixture
def start(command):
    """A function: start a command and wait until it captures; gives the program and where it captures."""
    with ExitStack() as running:

        def run(*arguments):
            program = running.enter_context(Program(command, *arguments))
            ready = program.line(program.err)
            assert ready.startswith("capturing on "), ready
            assert ready.endswith("; Ctrl-C ends\n")
            return program, ready.removeprefix("capturing on ").partition(";")[0]

        yield run


def end(program, how=signal.SIGINT):
    """End it as Ctrl-C does; return what it wrote."""
    out, err = program.end(how)
    assert "Traceback" not in err
    return out, err


def listening(where):
    """A connected socket towards a command that listens."""
    host, _, port = where.rpartition(":")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect((host, int(port)))
    return sender


def test_sniff_shows_each_packet_as_it_comes(start, link):
    send, port = link
    options = [*GROUND, "--topic", "/cmd_vel", "--json"]
    program, where = start("sniff", "-i", "lo", *options)
    assert where == "lo"
    for number in range(3):
        send(twist(number))
        shown = json.loads(program.line())
        assert shown["destination"] == f"127.0.0.1:{port}"
        assert (shown["link"], shown["message"]["linear"]["x"]) == ("ci", number)
    assert end(program) == ("", "")


def test_record_for_a_time(start, link, recording, tmp_path):
    send, _ = link
    options = [*GROUND, "--duration", "1s"]
    program, _ = start("record", "-i", "lo", *options, "-o", tmp_path / "x.mcap")
    for number in range(300):
        send(twist(number))
    _, err = program.end(None)
    assert err.startswith(f"{tmp_path}/x.mcap: ")
    read = recording(tmp_path / "x.mcap")
    # Where the machine stood still for that second, its end came before the last of them.
    came = numbers(read.topics["/cmd_vel"])
    assert came == list(range(len(came)))
    assert read.metadata["edoras"]["kernel_drops"] == "0"
    assert set(read.attachments) == {"rover_ground.yaml"}


@pytest.mark.quick("2")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_record_until_interrupted(how, start, link, recording, tmp_path):
    """Everything sent before Ctrl-C is in the recording."""
    send, _ = link
    options = ["--json", *GROUND]
    program, _ = start("record", "-i", "lo", *options, "-o", tmp_path / "x.mcap")
    for number in range(100):
        send(twist(number))
    out, _ = end(program, how)
    assert numbers(recording(tmp_path / "x.mcap").topics["/cmd_vel"]) == list(range(100))
    report = json.loads(out)
    assert (report["source"], report["kind"], report["capture_drops"]) == ("lo", "live", 0)


def test_record_all_takes_every_port(start, link, datagrams, tmp_path):
    send, port = link
    program, _ = start("record", "-i", "lo", "-a", "-o", tmp_path / "x.pcap")
    send(b"no packet of any link")
    end(program)
    ours = [item.payload for item in datagrams(tmp_path / "x.pcap") if item.destination == port]
    assert ours == [b"no packet of any link"]


def test_listen_needs_no_link_and_no_privilege(start):
    program, where = start("sniff", "--listen", "127.0.0.1:0", "--json")
    with listening(where) as sender:
        sender.send(b"whatever")
        assert json.loads(program.line())["destination"] == where
    assert end(program) == ("", "")


def test_record_from_sockets_until_a_count(start, recording, tmp_path):
    program, where = start("record", "--listen", "127.0.0.1:0", "-n", "5", "-o", tmp_path / "x.mcap")
    with listening(where) as sender:
        with contextlib.suppress(ConnectionRefusedError):  # it has its five, and has gone
            for number in range(9):
                sender.send(twist(number))
        program.end(None)
    assert recording(tmp_path / "x.mcap").counts["/edoras/datagrams"] == 5


@pytest.mark.quick("mcap")
@pytest.mark.parametrize("suffix", ["mcap", "pcap", "pcapng"])
def test_a_silent_link_leaves_a_whole_and_empty_file(suffix, start, call, tmp_path):
    program, _ = start(
        "record", "--listen", "127.0.0.1:0", "--duration", "300ms", "-o", tmp_path / f"x.{suffix}"
    )
    program.end(None)
    done = call("info", tmp_path / f"x.{suffix}")
    assert done.err == [
        f"edoras: {tmp_path}/x.{suffix}: no UDP datagram in it (it is empty); nothing to decode"
    ]


def test_killed_it_loses_nothing_that_was_there_before(start, call, recording, tmp_path):
    """What it writes once a second stays, without an end of the file."""
    cut, glance = tmp_path / "x.mcap", tmp_path / "glance.mcap"
    program, where = start("record", "--listen", "127.0.0.1:0", "-o", cut)
    sent = []

    def held(path):
        assert call("recover", path, "-o", tmp_path / "whole.mcap").code == 3  # its end is missing
        return recording(tmp_path / "whole.mcap").counts.get("/edoras/datagrams", 0)

    with listening(where) as sender:

        def there():
            sent.append(sender.send(twist(len(sent))))
            shutil.copy(cut, glance)
            return glance.stat().st_size > 10_000 and held(glance)

        before = program.until(there, "its file grows")
        program.end(signal.SIGKILL, code=-signal.SIGKILL)
    done = call("info", "--json", cut)
    assert done.code == 1
    assert f"`edoras recover {cut}` repairs it" in done.err[-1]
    assert call("recover", cut).code == 3
    back = recording(tmp_path / "x.recovered.mcap").counts["/edoras/datagrams"]
    assert 0 < before <= back <= len(sent)
    port = where.rpartition(":")[2]
    again = call("info", "--json", tmp_path / "x.recovered.mcap", "--port", f"ci:{port}")
    assert (again.code, again.json()["datagrams"]) == (0, back)


def test_the_simulation_on_sockets(command):
    """``sim`` answers on the real ports of its host, and ends with Ctrl-C."""
    host = "127.{}.{}.{}".format(*random.SystemRandom().sample(range(2, 250), 3))  # one's own
    with Program(command, "sim", "rover", "--host", host) as program:
        assert program.line(program.err).startswith(f"emulated cFS (rover) on {host}, UDP ")
        assert program.line()
        _, err = end(program)
    assert "datagrams sent; lost on the software bus: " in err
