"""``edoras proxy`` as a shell runs it: what it prints, what it returns, and how it ends."""

import json
import signal
import socket
from contextlib import ExitStack

import pytest
from schema import held
from waiting import HOST, PATIENCE_S, Program


@pytest.fixture
def target():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind((HOST, 0))
        opened.settimeout(PATIENCE_S)
        yield opened


@pytest.fixture
def started(command):
    """A function: start a proxy before a target; return it, and where it listens."""
    with ExitStack() as running:

        def start(target, *arguments, link="ci"):
            ends = ["--listen", f"{HOST}:0", "--target", f"{HOST}:{target.getsockname()[1]}"]
            proxy = running.enter_context(Program(command, "proxy", link, *ends, *arguments))
            told = proxy.line(proxy.err)
            assert told.startswith(f"relaying {link} {HOST}:"), told
            return proxy, (HOST, int(told.split()[2].rpartition(":")[2]))

        yield start


def send(count, address):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        for number in range(count):
            client.sendto(bytes.fromhex("1827c000000101") + bytes([number]), address)


def test_ctrl_c_prints_the_report_and_closes_the_recording(started, target, tmp_path, recording):
    path = tmp_path / "a.mcap"
    process, listen = started(target, "-o", path, "--fault", "drop:1,every=4", "--json")
    send(20, listen)
    assert [target.recv(99)[-1] for _ in range(15)] == [number for number in range(20) if number % 4 != 3]
    out, _ = process.end()
    report = held(json.loads(out), ["proxy", "--json"])
    assert [(way["name"], way["received"], way["sent"]) for way in report["ways"]] == [
        (f"to {HOST}:{target.getsockname()[1]}", 20, 15),
        ("to clients", 0, 0),
    ]
    assert report["faults"] == [{"rule": "drop:1,every=4", "kind": "drop", "on": True, "struck": 5}]
    assert (report["recorded"], report["lost"]) == (15, 0)
    assert report["ways"][0]["latency_us"]["p50"] > 0
    counts = recording(path).counts
    assert (counts["/edoras/datagrams"], counts["/edoras/faults"]) == (15, 5)


def test_a_report_for_people_says_who_refused(started, target):
    process, listen = started(target)
    target.close()
    send(5, listen)
    out, err = process.end(signal.SIGTERM)
    assert out == ""
    assert "refused" in err
    assert "nothing listens there" in err


def test_what_is_held_back_at_the_end_is_told_and_is_no_loss(started, target):
    process, listen = started(target, "--fault", "delay:1h", "-q")
    send(3, listen)
    _, err = process.end()
    assert "3 datagrams still held back on purpose" in err


def test_a_duration_ends_it(started, target):
    process, _ = started(target, "--duration", "50ms", "-q")
    assert process.end(None) == ("", "")


def test_what_the_proxy_itself_loses_is_counted_to_the_last_and_told_with_3(started, target):
    process, listen = started(target, "--json")
    process.process.send_signal(signal.SIGSTOP)  # it cannot keep up
    count, size = 150_000, 1000  # more than the largest receive buffer holds
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(listen)
        for _ in range(count):
            client.send(bytes(size))
    process.process.send_signal(signal.SIGCONT)
    report, err = process.end(code=3)
    report = json.loads(report)
    assert report["lost"] == report["ways"][0]["kernel_drops"] > 0
    assert report["ways"][0]["received"] + report["lost"] == count
    assert f"{report['lost']:,} datagrams lost before the proxy read them" in err


def test_a_dry_run_says_what_would_be_and_opens_nothing(call, target):
    port = target.getsockname()[1]
    ends = ("--listen", f"{HOST}:{port}", "--target", f"{HOST}:9")  # the port is in use: nobody asks for it
    result = call(
        "proxy", "to", *ends, "--to", "localhost:8", "--profile", "lunar", "--limit", "30", "--dry-run"
    )
    assert result.code == 0
    assert result.out.splitlines()[0] == (
        f"would relay to {HOST}:{port} → {HOST}:9, localhost:8; nothing was opened"
    )
    assert "  fault  delay:1282ms" in result.out
    assert "  fault  rate:30" in result.out
    plan = call("proxy", "to", *ends, "--seed", "7", "--dry-run", "--json").json()
    assert (plan["link"], plan["targets"], plan["seed"], plan["faults"]) == ("to", [f"{HOST}:9"], 7, [])


SCENARIO = "faults:\n  - drip: 0.1\n  - delay: soon\n"
WRONG = {
    ("ci", "--listen", "1", "--target", "1x"): (2, ["1x"]),
    ("ci", "--listen", "1"): (2, ["Missing option '--target'"]),
    ("cd", "--listen", "1", "--target", "2"): (2, ["cd"]),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:9"): (2, ["in a loop"]),
    ("to", "--target", f"{HOST}:9", "--listen", "9"): (2, ["in a loop"]),
    ("sbn", "--target", f"{HOST}:1", "--listen", "9", "--to", "localhost:9"): (2, ["in a loop"]),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "--fault", "drop:2", "--fault", "drip"): (
        2,
        ["fault drop:2: p '2': a probability", "fault drip: no such fault 'drip'; did you mean drop?"],
    ),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "--scenario", "s.yaml"): (
        2,
        ["s.yaml:2: faults[0]: none of drip is a fault", "s.yaml:3: faults[1].delay: time 'soon'"],
    ),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "--fault", "drop:1,where=x ="): (
        2,
        ["equality", "x =", "^"],
    ),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "--limit", "/cmd_vel=3"): (1, ["no topic"]),
    ("ci", "--target", "192.0.2.1:9", "--listen", f"{HOST}:0"): (2, ["is not on this machine's loopback"]),
    ("ci", "--target", "no.such.host.invalid:9", "--listen", f"{HOST}:0", "--yes"): (
        1,
        ["neither an address nor the name of a known host"],
    ),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "-o", "a.txt"): (
        2,
        ["unknown suffix"],
    ),
    ("ci", "--target", f"{HOST}:9", "--listen", f"{HOST}:0", "-o", "/proc/no/where.mcap"): (
        1,
        ["/proc/no/where.mcap"],
    ),
}


@pytest.mark.parametrize("arguments", WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_one_line_a_mistake(call, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SCENARIO)
    result = call("proxy", *arguments, "--duration", "100ms")
    code, lines = WRONG[arguments]
    assert result.code == code, result.err
    assert result.out == ""
    assert len(result.err) == len(lines), result.err
    for line, part in zip(result.err, lines, strict=True):
        assert line.startswith("edoras: ")
        assert part in line


def test_a_port_in_use_is_told_before_a_recording_is_begun(call, target, tmp_path):
    ends = ("--listen", f"{HOST}:{target.getsockname()[1]}", "--target", f"{HOST}:9")
    result = call("proxy", "ci", *ends, "-o", tmp_path / "a.mcap")
    assert result.code == 1
    assert "another program has port" in result.err[0]
    assert not list(tmp_path.iterdir())


ENDS = ("--listen", f"{HOST}:0", "--target", f"{HOST}:9")
WRONG_STREAMS = {
    ("ci", "--tcp"): "ci is not a link over TCP",
    ("sbn", "--cut", "1s"): "add --tcp",
    ("sbn", "--tcp", "--to", f"{HOST}:8"): "a TCP connection has one target",
    ("racs2", "--fault", "drop:0.1"): "a TCP stream cannot have this fault",
    ("racs2", "-o", "x.mcap"): "does not record",
}


@pytest.mark.parametrize("arguments", WRONG_STREAMS, ids=range(len(WRONG_STREAMS)))
def test_what_a_stream_cannot_have_is_told_in_one_line(call, arguments):
    result = call("proxy", *arguments, *ENDS)
    (line,) = result.err
    assert (result.code, WRONG_STREAMS[arguments] in line) == (2, True), line


def test_tcp_is_relayed_and_counted(command):
    with socket.create_server((HOST, 0)) as server:
        server.settimeout(PATIENCE_S)
        ends = ["--listen", f"{HOST}:0", "--target", f"{HOST}:{server.getsockname()[1]}"]
        arguments = ["racs2", *ends, "--fault", "delay:20ms,to=cfs", "--json"]
        with Program(command, "proxy", *arguments) as proxy:
            told = proxy.line(proxy.err)
            assert told.startswith("relaying RACS2 over TCP"), told
            port = int(told.split(",")[1].split()[0].rpartition(":")[2])
            with socket.create_connection((HOST, port)) as client:
                client.settimeout(PATIENCE_S)
                client.sendall(b"there")
                accepted, _ = server.accept()
                with accepted:
                    accepted.settimeout(PATIENCE_S)
                    assert accepted.recv(99) == b"there"
                    accepted.sendall(b"and back")
                    assert client.recv(99) == b"and back"
            out, _ = proxy.end()
    report = held(json.loads(out), ["proxy", "--json"])
    assert (report["connections"], report["bytes_to_target"], report["bytes_to_client"]) == (1, 5, 8)
    assert report["faults"][0]["struck"] == 1
