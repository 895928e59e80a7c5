"""``edoras host``, and what a recording notes of its host: a slow reader of ours on CI's port."""

import signal
import socket
from contextlib import closing

import pytest
from namespace import inside
from waiting import Program

from edoras_tools.decode import Context
from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.links import usual_ports

SENT = 300


def test_the_usual_ports_are_those_of_the_links():
    context = Context()
    links = {port: context.claimants[context.claim[port]] for port in context.capture_ports()}
    assert usual_ports() == {port: "/".join(link.label for link in item) for port, item in links.items()}


def slow_reader():
    """A socket on CI's port that holds few datagrams."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    made.bind(("127.0.0.1", 1234))
    made.setblocking(False)
    return made


def overrun(reader, datagram):
    """Send more than it holds, then read all that is there; return how many it missed."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        for _ in range(SENT):
            sender.sendto(datagram, ("127.0.0.1", 1234))
    read = 0
    while True:
        try:
            reader.recv(100)
        except BlockingIOError:
            return SENT - read
        read += 1


def test_what_is_dropped_is_shown_once_with_what_to_change(command):
    def work():
        told = []
        with closing(slow_reader()) as reader:
            for arguments in ((), ("--json",)):
                missed = overrun(reader, bytes(76)) + (told[-1][0] if told else 0)
                with Program(command, "host", *arguments) as program:
                    told.append((missed, program.end(None, 3)[0]))
        with Program(command, "host") as program:
            return told, program.end(None)[0]

    ((missed, text), (later, document)), quiet = inside(work)
    row = next(line.split() for line in text.splitlines() if line.split()[:1] == ["1234"])
    assert row[:3] + row[-1:] == ["1234", "ci", "127.0.0.1", f"{missed:,}"]
    assert f"{missed} datagrams dropped in full sockets" in text
    assert "sudo sysctl -w net.core.rmem_default=" in text
    assert f'"drops": {later}' in document
    assert quiet.startswith("no program here listens on a UDP port of the links")


@pytest.mark.long
def test_a_recording_notes_what_the_kernel_drops_and_the_doctor_says_it(command, call, missions, tmp_path):
    path = tmp_path / "x.mcap"
    twist = bytes.fromhex("1827 0000 0045 0100") + bytes(68)

    def work():
        with (
            closing(slow_reader()) as reader,
            Program(
                command, "record", "--json", "-i", "lo", *missions("rover_ground"), "-o", path
            ) as program,
        ):
            while "capturing" not in program.line(program.err):
                pass
            missed = overrun(reader, twist)
            program.end(signal.SIGINT)
            return missed

    missed = inside(work)
    with closing(McapSource(path)) as source:
        readings = source.host()
    assert len(readings) >= 2
    first, last = (
        {item.port: item.drops for item in reading.sockets} for reading in (readings[0], readings[-1])
    )
    assert (first, last) == ({1234: 0}, {1234: missed})
    assert last[1234] == readings[-1].receive_buffer_errors - readings[0].receive_buffer_errors
    (found,) = (
        item for item in call("doctor", "--json", path).json()["verdicts"] if item["rule"] == "ci_backlog"
    )
    assert (found["lost"], found["of"], found["link"]) == (missed, SENT, "ci")
    assert any("the kernel's counter" in item for item in found["evidence"])
