"""``record --snapshot`` as a user runs it: on a live port, with a signal, a socket, and Ctrl-C."""

import json
import re
import signal
import socket
import struct
from pathlib import Path

import pytest
from schema import held
from waiting import HOST, Program, free_ports


def sent(opened, port, first, count, code=1):
    """Send commands with a number behind their header."""
    for number in range(first, first + count):
        opened.sendto(struct.pack(">HHHBBQ", 0x1827, 0xC000, 9, code, 0, number), (HOST, port))
    return first + count


def numbers(path):
    """Read the numbers from a pcap of raw IPv4 packets, by its definition alone."""
    data, found = Path(path).read_bytes(), []
    assert struct.unpack_from("<I", data, 20) == (101,)
    place = 24
    while place < len(data):
        length = struct.unpack_from("<I", data, place + 8)[0]
        found.append(struct.unpack_from(">Q", data, place + 16 + 20 + 8 + 8)[0])
        place += 16 + length
    return found


def test_a_signal_a_socket_and_ctrl_c(command, tmp_path):
    (tmp_path / "now.pcap").write_text("an older file, which is not touched")
    words = ["--snapshot", "-o", tmp_path / "now.pcap", "--before", "1h", "--after", "100ms", "--json"]
    with (
        Program(command, "record", "--listen", "0", *words, "--socket", tmp_path / "s") as recorder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened,
    ):
        port = int(re.search(r":(\d+)", recorder.line(recorder.err))[1])
        count = sent(opened, port, 0, 500)
        with Program(command, "record", "--fire", tmp_path / "s") as asking:
            assert "asked for on the socket" in asking.line()
            asking.end(None)
        assert "asked for on the socket" in recorder.line(recorder.err)
        count = sent(opened, port, count, 500)
        recorder.process.send_signal(signal.SIGUSR1)
        assert "signal USR1" in recorder.line(recorder.err)
        out, _ = recorder.end()
    report = held(json.loads(out), ["record", "--json"])
    assert report["datagrams"] == count
    assert [item["reasons"] for item in report["snapshots"]] == [["asked for on the socket"], ["signal USR1"]]
    first, second = (numbers(path) for path in report["outputs"])
    assert second == list(range(count))
    assert first == second[: len(first)]
    assert len(first) >= 500
    assert (tmp_path / "now.pcap").read_text() == "an older file, which is not touched"
    assert not (tmp_path / "s").exists()


def test_ctrl_c_before_the_time_after_is_over(command, tmp_path):
    (port,) = free_ports(1)
    fires = "where:function_code == 9"
    words = ["--snapshot", "-o", tmp_path / "a.pcap", "--after", "1h", "--trigger", fires]
    with (
        Program(command, "record", "--listen", port, "--port", f"ci:{port}", *words, "--json") as recorder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened,
    ):
        assert "capturing" in recorder.line(recorder.err)
        sent(opened, port, 0, 100)
        sent(opened, port, 100, 1, code=9)
        sent(opened, port, 101, 100)
        recorder.until(lambda: list(tmp_path.glob("a_*.pcap")), "a file is begun")
        out, err = recorder.end()
    (path,) = json.loads(out)["outputs"]
    assert numbers(path) == list(range(201))
    assert "function_code == 9" in err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--before 5", "--before is an option of --snapshot"),
        ("--trigger finding", "--trigger is an option of --snapshot"),
        ("--snapshot --split-time 5", "leave the --split options out"),
        ("--snapshot --rosbag2", "leave one of them out"),
        ("--snapshot --before-size 10k", "--before is less than 1M"),
        ("--snapshot --trigger findings", "did you mean finding?"),
        ("--snapshot --trigger finding:truncatd", "did you mean truncated?"),
        ("--snapshot --trigger rule:sbn_timeouts", "did you mean sbn_timeout?"),
        ("--snapshot --trigger where:", "write finding, finding:NAME"),
        ("--snapshot --trigger where:((", "character"),
        ("--snapshot --trigger where:nothing==1", "is not a field"),
    ],
)
def test_refused(words, told, call, captures, tmp_path):
    done = call("record", captures("a_rover"), "-o", tmp_path / "a.pcap", *words.split(" "))
    assert done.code == 2
    assert told in " ".join(done.err)
    assert not list(tmp_path.iterdir())


def test_no_recorder_at_the_socket(call, tmp_path):
    done = call("record", "--fire", tmp_path / "s")
    assert done.code == 1
    assert "no recorder listens there" in done.err[0]
