"""``edoras live`` as a shell runs it, and as Foxglove sees it."""

import json
import re
import signal
import socket
import struct
import subprocess
import sys
from contextlib import closing

import foxglove_client as peer
import pytest
import warm
from schema import held
from waiting import Program
from websockets.exceptions import InvalidStatus

from edoras_tools.io.formats.open import open_file

TWIST = "geometry_msgs/msg/Twist"
CDR = bytes.fromhex("00010000") + struct.pack("<6d", 0.5, 0, 0, 0, 0, -1)


@pytest.fixture
def started(command):
    """A function: start it; return it, and where Foxglove connects to."""
    running = []

    def start(*arguments):
        process = warm.Popen(
            [command, "live", "--ws-port", "0", *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        told = process.stderr.readline()
        found = re.search(
            r"https://app\.foxglove\.dev/\?ds=foxglove-websocket&ds\.url=(ws://127\.0\.0\.1:\d+)$", told
        )
        assert found, told + process.stderr.read()
        assert process.stderr.readline() == f"or in a browser: http{found[1].removeprefix('ws')}/\n"
        return process, found[1]

    yield start
    for process in running:
        process.kill()
        process.communicate()


@pytest.mark.long
def test_a_capture_through_a_pipe_is_shown_as_it_comes(command, captures, missions, tmp_path):
    """As of ``tcpdump -U -w - | edoras live -``: what was written is shown while the pipe is open."""
    data = captures("a_rover").read_bytes()
    half = len(data) // 2  # in the middle of a packet
    words = [command, "live", "-", "--live", "0", "-o", tmp_path / "a.mcap", *missions("rover_ground")]
    with Program(*words, stdin=subprocess.PIPE) as program:
        pipe = program.process.stdin.buffer
        pipe.write(data[:half])
        pipe.flush()
        url = program.line(program.err).rpartition("ds.url=")[2].strip()
        with peer.Client(url, 7) as client:
            client.subscribe("/cmd_vel")
            pipe.write(data[half : half + 20_000])
            pipe.flush()
            client.until(lambda: client.messages)
            pipe.write(data[half + 20_000 :])
            pipe.close()
            client.until(lambda: len(client.messages) > 200)
        program.end(None)
    with closing(open_file(tmp_path / "a.mcap")) as source:
        assert sum(map(len, source.batches())) == 1827


def interrupt(process):
    process.send_signal(signal.SIGINT)
    return process.communicate(timeout=peer.PATIENCE_S)


def test_a_recording_is_played_back_and_steered(started, captures, missions):
    process, url = started(captures("a_rover"), *missions("rover_ground"), "--paused")
    with peer.Client(url, 7) as client:
        assert client.info["name"].endswith("a_rover.pcap")
        assert "playbackControl" in client.info["capabilities"]
        start = client.info["dataStartTime"]["sec"] * 10**9 + client.info["dataStartTime"]["nsec"]
        client.subscribe("/cmd_vel")
        client.until(lambda: client.states)
        assert client.states[0].status == "paused"
        seek = start + 30 * 10**9
        assert client.control(play=True, speed=20.0, seek_ns=seek)[:3] == ("playing", seek, 20.0)
        client.until(lambda: client.messages and client.messages[-1].time_ns > seek + 10**10)
        _, err = interrupt(process)
    assert process.returncode == 0
    assert re.search(r"^Foxglove: 1 client, \d+ messages sent$", err, re.MULTILINE)


def test_web_pages_of_strangers_are_kept_out_and_told(started, captures):
    process, url = started(captures("a_rover"), "--allow-origin", "https://viz.example.org", "-q")
    with pytest.raises(InvalidStatus, match="HTTP 403"):
        peer.Client(url, origin="https://evil.example")
    assert process.stderr.readline() == (
        "edoras: a web page of https://evil.example was refused as a client; "
        "--allow-origin https://evil.example allows it\n"
    )
    for origin in ("https://viz.example.org", "https://app.foxglove.dev"):
        with peer.Client(url, 5, origin=origin) as client:
            assert client.channels
    interrupt(process)
    assert process.returncode == 0


@pytest.mark.long
def test_a_cut_off_recording_is_played_and_said_to_be_one(started, captures, missions, tmp_path):
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(captures("a_rover").read_bytes()[:60_000])
    process, _ = started(cut, *missions("rover_ground"))
    _, err = interrupt(process)
    assert process.returncode == 1
    assert err.splitlines()[-1].startswith(f"edoras: {cut}: ")


def test_an_emulated_cfs_takes_commands_where_it_is_allowed(started):
    process, url = started("--sim", "rover", "--allow-publish", "/cmd_*", "--json")
    with peer.Client(url, 7) as client:
        client.subscribe("/cmd_vel", "/telemetry_pose")
        client.advertise(1, "/cmd_vel", TWIST)
        client.advertise(2, "/telemetry_pose", "geometry_msgs/msg/PoseStamped")
        client.publish(2, b"")
        client.until(lambda: client.statuses)
        assert client.statuses[0]["message"] == (
            "/telemetry_pose may not be published; --allow allows /cmd_vel"
        )
        client.publish(1, CDR)
        client.until(lambda: any(item.data == CDR for item in client.on("/cmd_vel")))
        client.until(lambda: client.on("/telemetry_pose"))
        out, err = interrupt(process)
    assert (process.returncode, err) == (0, "")
    report = held(json.loads(out), ["live", "--json"])
    assert report["kind"] == "sim"
    told = report["foxglove"]
    assert (told["published"], told["refused"], told["dropped"]) == (1, 1, 0)
    assert told["clients"][0]["sent"] == told["sent"] > 1


def test_sockets_are_shown_and_commands_go_to_the_target(started, missions):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as cfs:
        cfs.bind(("127.0.0.1", 0))
        cfs.settimeout(peer.PATIENCE_S)
        target = f"127.0.0.1:{cfs.getsockname()[1]}"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        process, url = started(
            *("--listen", f"127.0.0.1:{port}", "--port", f"ci:{port}", *missions("rover_ground")),
            *("--allow-publish", "*", "--target", target),
        )
        with peer.Client(url, 7) as client:
            client.subscribe("/cmd_vel")
            client.advertise(1, "/cmd_vel", TWIST)
            client.publish(1, CDR)
            command = cfs.recv(4096)
            assert command.endswith(CDR)

            def shown():
                cfs.sendto(command, ("127.0.0.1", port))
                return client.messages

            client.until(shown)
            assert client.messages[0].data == CDR
            _, err = interrupt(process)
        assert process.returncode == 0
        assert err.splitlines()[-1].endswith("1 taken from them, 0 refused")


@pytest.mark.long
def test_a_proxy_is_looked_at_while_it_relays(command, missions):
    """The line that says where to look comes first; what crosses, faults included, is shown."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as cfs:
        cfs.bind(("127.0.0.1", 0))
        ends = ["--listen", "127.0.0.1:0", "--target", f"127.0.0.1:{cfs.getsockname()[1]}"]
        process = subprocess.Popen(
            [
                command,
                "proxy",
                "ci",
                *ends,
                *missions("rover_ground"),
                "--live",
                "0",
                "--fault",
                "drop:1,every=2",
            ],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            url = process.stderr.readline().rpartition("ds.url=")[2].strip()
            assert process.stderr.readline() == f"or in a browser: http{url.removeprefix('ws')}/\n"
            port = int(re.match(r"relaying ci 127\.0\.0\.1:(\d+)", process.stderr.readline())[1])
            with peer.Client(url, 7) as client:
                client.subscribe("/cmd_vel")
                peer_packet = bytes.fromhex("18270000004501003400000000000000 3400000000000000") + CDR

                def shown():
                    cfs.sendto(peer_packet, ("127.0.0.1", port))
                    return client.messages and "/edoras/faults" in client.channels

                client.until(shown)
                assert client.messages[0].data == CDR
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=peer.PATIENCE_S)
        finally:
            process.kill()
            process.communicate()
        assert process.returncode == 0, err
        assert re.search(r"^Foxglove: 1 client, \d+ messages? sent$", err, re.MULTILINE)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((), "name one source: FILE, -i IFACE, --listen PORT or --sim DEMO"),
        (("a.pcap", "--sim", "rover"), "name one source"),
        (("a.pcap", "--allow-publish", "*"), "can only be used with live traffic"),
        (("--sim", "rover", "--speed", "2"), "can only be used with a recording"),
        (("--sim", "rover", "--no-wait"), "can only be used with a recording"),
        (("a.pcap", "--paused", "--no-wait"), "use one of them"),
        (("nowhere.pcap",), "nowhere.pcap: "),
        (("-",), "-: "),
        (("--sim", "rover", "--allow-publish", "/nowhere"), "'/nowhere' matches no topic that goes to cFS"),
        (("--sim", "rover", "--topic", "/nowhere"), "no configured topic matches '/nowhere'"),
        (("--sim", "rover", "--host", "192.0.2.1"), "192.0.2.1:0: cannot listen"),
        (("--sim", "rover", "-o", "a.txt"), "a.txt: unknown suffix"),
        (
            ["--sim", "rover", "--allow-origin", "viz.lab"],
            "edoras: 'viz.lab' is not an origin; write it like",
        ),
    ],
)
def test_bad_input_is_one_line(call, arguments, line):
    result = call("live", "--ws-port", "0", *arguments)
    assert result.code in {1, 2}
    assert line in result.err[-1]
    assert len([item for item in result.err if item.startswith("edoras: ")]) == 1


def test_a_port_in_use_is_one_line(call):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = call("live", "--sim", "rover", "--ws-port", port)
    assert result.code == 1
    assert len(result.err) == 1
    assert result.err[0].startswith(
        f"edoras: 127.0.0.1:{port}: cannot listen: Address already in use; name another port"
    )


def test_another_machine_is_sent_to_only_if_it_is_meant(call, missions):
    result = call(
        *("live", "--ws-port", "0", "--listen", "127.0.0.1:0", *missions("rover_ground")),
        *("--allow-publish", "*", "--target", "192.0.2.1:1234"),
    )
    assert result.code == 2
    assert "192.0.2.1:1234 is not on this machine's loopback; nothing was sent" in result.err[-1]


def test_without_websockets_it_is_said_what_to_install(call, monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    result = call("live", "--ws-port", "0", "--sim", "rover")
    assert result.code == 2
    assert result.err == [
        "edoras: Foxglove needs websockets, which is not installed: pip install 'edoras-tools[live]'"
    ]
