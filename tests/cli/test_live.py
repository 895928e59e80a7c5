"""Live capture through the commands: on loopback, this process being the bridge; CAP_NET_RAW for ``-i``."""

import json
import select
import signal
import socket
import struct
import subprocess
import time
from contextlib import ExitStack

import pytest

HEADER = bytes.fromhex("1827 0000 0045 01 00") + struct.pack("<QQ", 52, 52) + bytes.fromhex("00010000")


def twist(number):
    """A command as the ground bridge sends it; its number is the speed."""
    return HEADER + struct.pack("<6d", number, 0, 0, 0, 0, 0)


def numbers(messages):
    """The numbers of recorded Twists."""
    return [int(struct.unpack_from("<d", message.data, 4)[0]) for message in messages]


@pytest.fixture
def link():
    """A function that sends datagrams, and the port that they go to."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        yield sender.send, receiver.getsockname()[1]


@pytest.fixture
def start(command):
    """A function: start a command and wait until it captures; gives the process and where it captures."""
    with ExitStack() as running:

        def run(*arguments):
            process = running.enter_context(
                subprocess.Popen(
                    [command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
                )
            )
            running.callback(process.kill)
            ready = process.stderr.readline().decode()
            assert ready.startswith("capturing on "), ready
            assert ready.endswith("; Ctrl-C ends\n")
            return process, ready.removeprefix("capturing on ").partition(";")[0]

        yield run


def end(process, how=signal.SIGINT):
    """End it as Ctrl-C does; return what it wrote."""
    process.send_signal(how)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert b"Traceback" not in err
    return out.decode(), err.decode()


def line(stream, seconds=20):
    """The next line of a pipe, which must come while the process goes on."""
    assert select.select([stream], [], [], seconds)[0], "nothing came"
    return stream.readline().decode()


def listening(where):
    """A connected socket towards a command that listens."""
    host, _, port = where.rpartition(":")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect((host, int(port)))
    return sender


def test_sniff_shows_each_packet_as_it_comes(start, link, missions):
    send, port = link
    options = ["--port", f"ci:{port}", *missions("rover_ground"), "--topic", "/cmd_vel", "--json"]
    process, where = start("sniff", "-i", "lo", *options)
    assert where == "lo"
    for number in range(3):
        send(twist(number))
        shown = json.loads(line(process.stdout))
        assert shown["destination"] == f"127.0.0.1:{port}"
        assert (shown["link"], shown["message"]["linear"]["x"]) == ("ci", number)
    assert end(process) == ("", "")


def test_record_for_a_time(start, link, missions, recording, tmp_path):
    send, port = link
    options = ["--port", f"ci:{port}", *missions("rover_ground"), "--duration", "1s"]
    process, _ = start("record", "-i", "lo", *options, "-o", tmp_path / "x.mcap")
    for number in range(300):
        send(twist(number))
        time.sleep(0.001)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 0
    assert err.decode().startswith(f"{tmp_path}/x.mcap: ")
    read = recording(tmp_path / "x.mcap")
    assert numbers(read.topics["/cmd_vel"]) == list(range(300))
    assert read.metadata["edoras"]["kernel_drops"] == "0"
    assert set(read.attachments) == {"rover_ground.yaml"}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_record_until_interrupted(how, start, link, missions, recording, tmp_path):
    """Everything sent before Ctrl-C is in the recording."""
    send, port = link
    options = ["--json", "--port", f"ci:{port}", *missions("rover_ground")]
    process, _ = start("record", "-i", "lo", *options, "-o", tmp_path / "x.mcap")
    for number in range(100):
        send(twist(number))
    out, _ = end(process, how)
    assert numbers(recording(tmp_path / "x.mcap").topics["/cmd_vel"]) == list(range(100))
    report = json.loads(out)
    assert (report["source"], report["kind"], report["capture_drops"]) == ("lo", "live", 0)


def test_record_all_takes_every_port(start, link, datagrams, tmp_path):
    send, port = link
    process, _ = start("record", "-i", "lo", "-a", "-o", tmp_path / "x.pcap")
    send(b"no packet of any link")
    end(process)
    ours = [item.payload for item in datagrams(tmp_path / "x.pcap") if item.destination == port]
    assert ours == [b"no packet of any link"]


def test_listen_needs_no_link_and_no_privilege(start):
    process, where = start("sniff", "--listen", "127.0.0.1:0", "--json")
    with listening(where) as sender:
        sender.send(b"whatever")
        assert json.loads(line(process.stdout))["destination"] == where
    assert end(process) == ("", "")


def test_record_from_sockets_until_a_count(start, recording, tmp_path):
    process, where = start("record", "--listen", "127.0.0.1:0", "-n", "5", "-o", tmp_path / "x.mcap")
    with listening(where) as sender:
        for number in range(9):
            sender.send(twist(number))
        process.communicate(timeout=20)
    assert process.returncode == 0
    assert recording(tmp_path / "x.mcap").counts["/edoras/datagrams"] == 5


@pytest.mark.parametrize("suffix", ["mcap", "pcap", "pcapng"])
def test_a_silent_link_leaves_a_whole_and_empty_file(suffix, start, call, tmp_path):
    process, _ = start(
        "record", "--listen", "127.0.0.1:0", "--duration", "300ms", "-o", tmp_path / f"x.{suffix}"
    )
    process.communicate(timeout=20)
    assert process.returncode == 0
    done = call("info", tmp_path / f"x.{suffix}")
    assert done.err == [
        f"edoras: {tmp_path}/x.{suffix}: no UDP datagram in it (it is empty); nothing to decode"
    ]


def test_killed_it_loses_a_second_at_most(start, call, recording, tmp_path):
    cut = tmp_path / "x.mcap"
    process, where = start("record", "--listen", "127.0.0.1:0", "-o", cut)
    began = time.monotonic()
    with listening(where) as sender:
        sent = []
        while time.monotonic() < began + 2.2:
            sent.append(time.time_ns())
            sender.send(twist(len(sent)))
            time.sleep(0.002)
        process.kill()
        killed = time.time_ns()
        process.wait(timeout=20)
    assert process.returncode == -signal.SIGKILL
    done = call("info", "--json", cut)
    assert (done.code, len(done.err)) == (1, 1)
    assert f"`edoras recover {cut}` makes it whole" in done.err[0]
    assert call("recover", cut).code == 0
    back = recording(tmp_path / "x.recovered.mcap").counts["/edoras/datagrams"]
    assert back >= sum(time_ns < killed - 10**9 for time_ns in sent) > 100
    again = call("info", "--json", tmp_path / "x.recovered.mcap")
    assert (again.code, again.json()["datagrams"]) == (0, back)


def test_the_simulation_on_sockets(command):
    """``sim`` answers on the real ports of its host, and ends with Ctrl-C."""
    process = subprocess.Popen(
        [command, "sim", "rover", "--host", "127.0.7.7"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        ready = line(process.stderr)
        assert ready.startswith("emulated cFS (rover) on 127.0.7.7, UDP ")
        assert line(process.stdout)
        _, err = end(process)
    finally:
        process.kill()
        process.communicate()
    assert "datagrams sent; lost on the software bus: " in err
