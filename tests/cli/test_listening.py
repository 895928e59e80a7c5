"""What listens where: two machines, made of network namespaces, and which ports of one answer the other.

By its defaults no command of ours answers another machine. Where ``0.0.0.0`` was written, what was named
answers, and a line has said so. A port answers where a datagram to it is not refused, or a connection opens.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from places import ROOT
from waiting import Program, until

NEAR, FAR = "10.77.0.1", "10.77.0.2"
MISSIONS = ROOT / "samples/missions"
ROVER = MISSIONS / "rover_ground.yaml"
FLIGHT = MISSIONS / "two_rovers_flight.yaml"

pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, ("unshare", "nsenter", "ip"))), reason="needs util-linux and iproute2"
)

PROBE = """
import json, os, socket, sys, time
host, ports = sys.argv[1], json.loads(sys.argv[2])
NOBODYS = 9
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # on one processor, refusals come in order

def accepting(ports):
    "UDP ports that refuse nothing, asked in turn, until one behind them that nobody has is refused."
    left = {port: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for port in (*ports, NOBODYS)}
    for port, opened in left.items():
        opened.setblocking(False)
        opened.connect((host, port))

    def refused(ask):
        for port, opened in list(left.items()):
            try:
                ask(opened)
            except BlockingIOError:
                pass
            except ConnectionRefusedError:
                left.pop(port).close()

    while NOBODYS in left:
        refused(lambda opened: opened.send(b"hello"))
        time.sleep(0.05)
        refused(lambda opened: opened.recv(1))
    refused(lambda opened: opened.recv(1))
    return list(left)

def connecting(port):
    with socket.socket() as opened:
        opened.settimeout(60)
        return opened.connect_ex((host, port)) == 0

assert accepting([NOBODYS + 1]) == [], "a port that nobody has answers: the probe proves nothing"
answering = [["udp", port] for port in accepting(port for kind, port in ports if kind == "udp")]
answering += [["tcp", port] for kind, port in ports if kind == "tcp" and connecting(port)]
print(json.dumps(answering))
"""


def netns(pid):
    return Path(f"/proc/{pid}/ns/net").readlink()


class Machines:
    """Two of them, on one wire; commands run on the near one, and are asked from the far one."""

    def __init__(self, stack):
        self._near = self._hold(stack, ["unshare", "--map-root-user", "--net"], netns("self"))
        self._far = self._hold(stack, [*self.enter(self._near), "unshare", "--net"], netns(self._near))
        self._in(self._near, "ip", "link", "set", "lo", "up")
        self._in(self._far, "ip", "link", "set", "lo", "up")
        wire = ["type", "veth", "peer", "name", "edfar", "netns", str(self._far)]
        self._in(self._near, "ip", "link", "add", "ednear", *wire)
        for where, name, address in ((self._near, "ednear", NEAR), (self._far, "edfar", FAR)):
            self._in(where, "ip", "address", "add", f"{address}/24", "dev", name)
            self._in(where, "ip", "link", "set", name, "up")
        # Refusals are rationed, and here each counts.
        self._in(self._near, "sh", "-c", "echo 0 > /proc/sys/net/ipv4/icmp_ratelimit || true")

    @staticmethod
    def enter(pid):
        return ["nsenter", "--target", str(pid), "--user", "--net", "--preserve-credentials"]

    def _hold(self, stack, words, before):
        process = stack.enter_context(subprocess.Popen([*words, "cat"], stdin=subprocess.PIPE))
        stack.callback(process.kill)
        until(lambda: process.poll() is not None or netns(process.pid) != before)
        until(lambda: Path(f"/proc/{process.pid}/comm").read_text().strip() == "cat")
        if process.poll() is not None:
            pytest.skip("no namespaces may be made here")
        return process.pid

    def _in(self, where, *words):
        done = subprocess.run([*self.enter(where), *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def start(self, stack, *words):
        return stack.enter_context(Program(*self.enter(self._near), *words))

    def ask(self, ports):
        """Which ports of the near machine answer the far one."""
        told = self._in(self._far, sys.executable, "-c", PROBE, NEAR, json.dumps(sorted(ports)))
        return {tuple(item) for item in json.loads(told)}

    def send(self, port, data):
        code = f"import socket; socket.socket(2, 2).sendto({data!r}, ({NEAR!r}, {port}))"
        self._in(self._far, sys.executable, "-c", code)


def family(pid):
    """A process and those that it started."""
    yield pid
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in path.read_text().split():
            yield from family(child)


def listening(program):
    """The ports that a program and its processes have bound: (kind, port)."""
    own = set()
    for pid in family(program.process.pid):
        for item in Path(f"/proc/{pid}/fd").glob("*"):
            with suppress(OSError):
                own.add(str(item.readlink()))
    found = set()
    for kind, states in (("udp", ("07", "01")), ("tcp", ("0A",))):
        for version in ("", "6"):
            lines = Path(f"/proc/{program.process.pid}/net/{kind}{version}").read_text().splitlines()[1:]
            for fields in map(str.split, lines):
                if fields[3] in states and f"socket:[{fields[9]}]" in own:
                    found.add((kind, int(fields[1].rpartition(":")[2], 16)))
    return found


@pytest.fixture(scope="module")
def machines():
    with ExitStack() as stack:
        yield Machines(stack)


def asked(machines, command, words, expected):
    """Start a command; give the ports that it has, those that answer from outside, and what it wrote."""
    with ExitStack() as stack:
        program = machines.start(stack, command, *words)
        program.until(lambda: set(expected) <= listening(program), f"it has {expected}")
        ports = listening(program)
        answering = machines.ask(ports)
        err = "".join(program.err.lines)
        return ports, answering, err


DEFAULTS = {
    "record": (["record", "--listen", 7001, "-o", "{tmp}/a.mcap"], [("udp", 7001)]),
    "sniff": (["sniff", "--listen", 7002], [("udp", 7002)]),
    "doctor": (["doctor", "--listen", 7003], [("udp", 7003)]),
    "live": (["live", "--listen", 7004], [("udp", 7004), ("tcp", 8765)]),
    "live_sim": (["live", "--sim", "rover"], [("tcp", 8765)]),
    "play": (["live", ROOT / "samples/captures/a_rover.pcap"], [("tcp", 8765)]),
    "proxy": (
        ["proxy", "ci", "--listen", 7005, "--target", "127.0.0.1:7006", "--live", 8766],
        [("udp", 7005), ("tcp", 8766)],
    ),
    "proxy_sbn": (
        ["proxy", "sbn", "--listen", 7007, "--target", "127.0.0.1:7008", "--bind", 7009],
        [("udp", 7007), ("udp", 7009)],
    ),
    "bridge": (["bridge", "-c", ROVER, "-c", FLIGHT, "--ros", "local"], [("udp", 1235), ("udp", 2236)]),
    "bridge_foxglove": (["bridge", "-c", ROVER, "--ros", "foxglove"], [("udp", 1235), ("tcp", 8765)]),
    "bridge_zenoh": (["bridge", "-c", ROVER, "--ros", "zenoh"], [("udp", 1235)]),
    "sim": (["sim"], [("udp", 1234), ("udp", 2234)]),
    "inject": (
        ["inject", "noop", "es", "--wait-for", "event:never", "--timeout", "60s"],
        [("udp", 1235)],
    ),
}


@pytest.mark.each(2)
@pytest.mark.quick("record", "bridge")
@pytest.mark.parametrize("name", DEFAULTS)
def test_by_default_nothing_answers_another_machine(machines, command, tmp_path, name):
    words, expected = DEFAULTS[name]
    words = [str(word).replace("{tmp}", str(tmp_path)) for word in words]
    ports, answering, err = asked(machines, command, words, expected)
    assert ports >= set(expected)
    assert answering == set()
    assert "is open" not in err


WRITTEN = {
    "record": (
        ["record", "--listen", "0.0.0.0:7001", "-o", "{tmp}/a.mcap"],
        {("udp", 7001)},
        "0.0.0.0:7001 is open: every machine that reaches it may send datagrams that count as captured",
    ),
    "live": (
        ["live", "--sim", "rover", "--host", "0.0.0.0"],
        {("tcp", 8765)},
        "0.0.0.0:8765 is open: every machine that reaches it may watch; with --token, clients must give a",
    ),
    "publish": (
        ["live", "--sim", "rover", "--host", "0.0.0.0", "--allow-publish", "/cmd_vel"],
        {("tcp", 8765)},
        "may watch and publish /cmd_vel into cFS; with --token, clients must give a token",
    ),
    "token": (
        ["live", "--sim", "rover", "--host", "0.0.0.0", "--token", "hush-hush"],
        {("tcp", 8765)},
        "0.0.0.0:8765 is open: every client that can reach it and has the token may watch; 127.0.0.1:8765",
    ),
    "proxy": (
        ["proxy", "ci", "--listen", "0.0.0.0:7005", "--target", "127.0.0.1:7006"],
        {("udp", 7005)},
        "edoras: 0.0.0.0:7005 is open: every machine that reaches it may send to 127.0.0.1:7006 through it",
    ),
    "bridge": (
        ["bridge", "-c", "{tmp}/rover.yaml", "--ros", "local"],
        {("udp", 1235)},
        "edoras: 0.0.0.0:1235 is open: every machine that reaches it may send what is published in ROS 2",
    ),
    "sim": (
        ["sim", "--host", "0.0.0.0"],
        {("udp", 1234), ("udp", 2234)},
        "0.0.0.0:1234 is open: every machine that reaches it may command the emulated cFS; leave --bind",
    ),
}


@pytest.mark.quick("token")
@pytest.mark.parametrize("name", WRITTEN)
def test_what_is_written_answers_and_it_is_said_who_may_speak(machines, command, tmp_path, name):
    words, expected, said = WRITTEN[name]
    (tmp_path / "rover.yaml").write_text(
        ROVER.read_text().replace('telemetry_ip: "127.0.0.1"', 'telemetry_ip: "0.0.0.0"')
    )
    words = [str(word).replace("{tmp}", str(tmp_path)) for word in words]
    _, answering, err = asked(machines, command, words, expected)
    assert answering >= expected
    assert said in err
    assert "hush-hush" not in err


@pytest.mark.long
def test_ros_2_over_dds_is_open_by_its_nature_and_it_is_said(machines, command):
    words = ["bridge", "-c", ROVER, "--ros", "dds"]
    ports, answering, err = asked(machines, command, words, [("udp", 1235), ("udp", 7400)])
    assert ("udp", 1235) in ports - answering
    assert ("udp", 7400) in answering
    assert (
        "edoras: the ROS 2 domain is open: every node on its network can publish messages that are bridged"
        in err
    )


@pytest.mark.long
def test_a_datagram_from_outside_is_recorded_once_it_is_let_in(machines, command, tmp_path):
    with ExitStack() as stack:
        words = ["record", "--listen", "0.0.0.0:7001", "-n", "1", "--json", "-o", tmp_path / "a.mcap"]
        program = machines.start(stack, command, *words)
        program.until(lambda: ("udp", 7001) in listening(program), "it listens")
        machines.send(7001, b"from outside")
        out, _ = program.end(how=None)
        assert json.loads(out)["datagrams"] == 1


def test_a_bridge_asks_before_it_sends_to_another_machine(edoras, tmp_path):
    path = tmp_path / "rover.yaml"
    path.write_text(ROVER.read_text().replace('fsw_ip: "127.0.0.1"', 'fsw_ip: "192.0.2.7"'))
    done = edoras("bridge", "-c", path, "--ros", "local")
    assert done.returncode == 2
    assert b"192.0.2.7:1234 is not on this machine's loopback; nothing was sent; confirm" in done.stderr
    done = edoras("bridge", "-c", path, "--ros", "local", "--yes", "--duration", "0.1", "--no-enable")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("token", ["", "short"])
def test_a_token_that_is_guessed_is_refused(edoras, token):
    done = edoras("live", "--sim", "rover", "--token", token, "--duration", "0.1")
    assert done.returncode == 2
    assert b"a token needs at least 8 characters" in done.stderr


@pytest.mark.long
def test_a_token_may_come_from_the_environment(edoras):
    done = edoras(
        *("live", "--sim", "rover", "--ws-port", 0, "--duration", "0.1"),
        env={"EDORAS_TOKEN": "hush-hush", "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == 0, done.stderr
    assert b"/?token=... with your token" in done.stderr
    assert b"hush" not in done.stderr
