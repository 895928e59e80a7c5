"""The extcap protocol, driven by hand as Wireshark drives it."""

import os
import re
import signal
import socket
import struct
import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from waiting import Program, free_ports

from edoras_tools.addons.wireshark import extcap
from edoras_tools.addons.wireshark.cli.extcap import main
from edoras_tools.addons.wireshark.program import install_extcap
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Peer
from edoras_tools.wire import cfe, sbn

SENTENCE = re.compile(r"(extcap|interface|dlt|arg|value) (\{\w+=[^{}]*\})+")


@pytest.fixture(scope="module")
def launcher(tmp_path_factory):
    return install_extcap(tmp_path_factory.mktemp("extcap"))


def asked(launcher, *arguments, code=0):
    done = subprocess.run([launcher, *arguments], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == code, done.stderr
    return done.stdout.splitlines() if not code else done.stderr.splitlines()


def test_interfaces(launcher):
    assert asked(launcher, "--extcap-interface", "edoras-ci", "--extcap-dlts") == extcap.link_types()
    lines = asked(launcher, "--extcap-interfaces", "--extcap-version=4.0")
    assert all(SENTENCE.fullmatch(line) for line in lines)
    assert [line.partition("display=")[2] for line in lines[1:]] == [
        "EDORAS CI}",
        "EDORAS TO}",
        "EDORAS SBN}",
        "EDORAS ROBOT}",
        "EDORAS CFDP}",
        "EDORAS FPRIME}",
        "EDORAS RACS2}",
    ]


@pytest.mark.parametrize("name", [f"edoras-{link.label}" for link in table.links()])
def test_link_types_and_options(name, capsys):
    assert main(["--extcap-interface", name, "--extcap-dlts"]) == 0
    assert capsys.readouterr().out == "dlt {number=101}{name=RAW}{display=Raw IP}\n"
    assert main(["--extcap-interface", name, "--extcap-config"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(SENTENCE.fullmatch(line) for line in lines)
    calls = [re.search(r"\{call=--(\w+)\}", line)[1] for line in lines if line.startswith("arg")]
    assert calls == ["interface", "listen", "ports", "config"]
    assert "value {arg=0}{value=lo}{display=lo}{default=false}" in lines


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--extcap-interface", "eth0", "--extcap-dlts"], "there are edoras-ci"),
        (["--extcap-interface", "edoras-ci"], "this program is for Wireshark"),
        (["--extcap-interface", "edoras-ci", "--capture", "--fifo=/x", "--ports=x"], "not a UDP port"),
        (["--extcap-interface", "edoras-ci", "--capture", "--fifo=/x", "--listen=:x"], "not an endpoint"),
        (["--extcap-interface", "edoras-ci", "--capture", "--fifo=/x", "--config=/nope.yaml"], "nope.yaml"),
        (["--extcap-interface", "edoras-ci", "--capture", "--fifo=/x/y", "--listen=127.0.0.1:0"], "/x/y"),
    ],
)
def test_mistakes_are_one_line(arguments, words, launcher):
    code = 1 if "/x/y" in words else 2
    (line,) = asked(launcher, *arguments, code=code)
    assert words in line


@contextmanager
def begin(launcher, tmp_path, *options):
    """Start a capture, with a reader on its fifo as Wireshark is one; give both."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with (
        open(os.open(fifo, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as reader,  # noqa: PTH123
        Program(launcher, "--capture", f"--fifo={fifo}", *options) as program,
    ):
        yield program, reader


def read(program, reader, enough):
    """Read until it is enough."""
    data = bytearray()

    def more():
        data.extend(reader.read(65536) or b"")
        return enough(data)

    program.until(more, "its blocks come")
    return bytes(data)


def _packets(data):
    at = count = 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<II", data, at)
        at += length
        count += kind == 6 and at <= len(data)
    return count


@pytest.mark.long
@pytest.mark.parametrize("way", ["listen", "live"])
def test_a_capture(way, launcher, tmp_path):
    port = 1234
    options = ["--interface=lo"]
    if way == "listen":
        (port,) = free_ports(1)
        options = [f"--listen=127.0.0.1:{port}"]
    packets = [cfe.emit_command(0x1827, 1, bytes([number])) for number in range(5)]
    with begin(launcher, tmp_path, "--extcap-interface=edoras-ci", *options) as (program, reader):
        head = read(
            program, reader, lambda data: len(data) >= 28
        )  # the section's header: it is bound, and nothing sent from here on is missed
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for packet in packets:
                sender.sendto(packet, ("127.0.0.1", port))
            if way == "live":  # another link's datagrams pass here too, and are not taken
                sender.sendto(sbn.emit(sbn.MsgType.HEARTBEAT, Peer(66, 1)), ("127.0.0.1", 2234))
                sender.sendto(cfe.emit_telemetry(0x0800, bytes(4)), ("127.0.0.1", 1235))
                sender.sendto(packets[0], ("127.0.0.1", port))
                packets.append(packets[0])
        data = head + read(program, reader, lambda data: _packets(head + data) >= len(packets))
        program.end(signal.SIGTERM)
    (tmp_path / "got.pcapng").write_bytes(data)
    with closing(open_file(tmp_path / "got.pcapng")) as source:
        got = [batch[row].payload for batch in source.batches() for row in range(len(batch))]
    # Whoever else talks on this machine's loopback is not of this test.
    assert [payload for payload in got if payload in packets] == packets
    assert all(payload[0] & 0x10 for payload in got)


@pytest.mark.long
def test_it_ends_when_wireshark_goes(launcher, tmp_path):
    options = "--extcap-interface=edoras-to", "--listen=127.0.0.1:0"
    with begin(launcher, tmp_path, *options) as (program, reader):
        read(program, reader, lambda data: len(data) >= 28)
        reader.close()
        program.end(None)


def test_ctrl_c_and_wireshark_s_own_signal_end_it_silently(launcher, tmp_path):
    options = "--extcap-interface=edoras-to", "--listen=127.0.0.1:0"
    with begin(launcher, tmp_path, *options) as (program, reader):
        read(program, reader, lambda data: len(data) >= 28)
        program.process.send_signal(signal.SIGINT)  # to everybody at that terminal
        # A second signal ends it at once, if the first has not yet.
        assert program.end(signal.SIGTERM, code=(0, -signal.SIGTERM)) == ("", "")


@pytest.mark.long
def test_it_ends_silently_while_nobody_reads_yet(launcher, tmp_path):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    (port,) = free_ports(1)
    options = "--extcap-interface=edoras-to", f"--fifo={fifo}", f"--listen=127.0.0.1:{port}"
    with Program(launcher, "--capture", *options) as program:
        program.until(lambda: f":{port:04X} " in Path("/proc/net/udp").read_text(), "it has its port")
        assert program.end(signal.SIGTERM) == ("", "")


def test_a_port_that_is_taken_is_said_in_one_line(launcher, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
        bridge.bind(("127.0.0.1", 0))
        port = bridge.getsockname()[1]
        (line,) = asked(
            launcher,
            *("--capture", "--extcap-interface=edoras-to", f"--fifo={tmp_path}/none"),
            f"--listen=127.0.0.1:{port}",
            code=1,
        )
    assert f"another program has port {port}" in line


def test_the_launcher_runs_this_python(launcher):
    assert sys.executable in launcher.read_text()
    assert os.access(launcher, os.X_OK)
    assert extcap.interface_link("edoras-sbn") is SBN
