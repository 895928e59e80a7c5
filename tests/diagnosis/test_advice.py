"""Advice is done: pasted into the same emulated run, as much is lost as it promised would be left."""

import re
import socket
from io import StringIO

import numpy as np
import pytest
from commands import call  # noqa: F401  a fixture
from rich.console import Console

from edoras_tools.cfs.commands import NAMED
from edoras_tools.cfs.queues import Queue
from edoras_tools.diagnosis.advice import Arrivals
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.model import Endpoint
from edoras_tools.render.doctor import screen
from edoras_tools.wire import cfe

POSE, TWIST, GENERATED, TO_PEER = 0x0827, 0x1827, 0x08F1, 0x082A
SECONDS = 25
OTHER_BRIDGE = Endpoint("127.0.0.1", 40_000)


def lost_of(found, msg_id):
    return sum(row.all_lost + row.unaccounted for row in found.balance if row.msg_id == msg_id)


def problem_of(found, msg_id):
    """Return the problem of a MsgId, whose promise is kept by what was done."""
    problem = next(
        item
        for item in summarize(found).problems
        if item.lost and any(verdict.msg_id == msg_id for verdict in item.verdicts)
    )
    assert lost_of(found, msg_id) > 0
    assert problem.left is not None, problem
    return problem


def rate_in(remedy):
    return float(re.search(r"at most ([\d.]+) Hz", remedy)[1])


@pytest.fixture
def pasted(call):  # noqa: F811
    """A function: run the lines below ``do`` on the first screen; return what they send, a second apart."""

    def run(found, at_s, *names):
        console = Console(width=80, record=True, file=StringIO())
        console.print(screen(found, 80, "run.pcap"))
        rows = [row.strip() for row in console.export_text().splitlines()]
        lines = list(dict.fromkeys(row for row in rows if row.startswith("edoras inject")))
        assert [line.split()[2] for line in lines] == [*names]
        feeds = []
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ci:
            ci.bind(("127.0.0.1", 0))
            ci.settimeout(30)
            for place, line in enumerate(lines):
                there = "--target", f"127.0.0.1:{ci.getsockname()[1]}"
                assert call(*line.split()[1:], *there, "--no-listen").code == 0, line
                feeds.append((at_s + place, 1234, ci.recv(2048)))
        return tuple(feeds)

    return run


@pytest.mark.quick("20")
@pytest.mark.parametrize("hz", [10, 20, 40])
def test_send_at_most_so_many(lab, hz):
    problem = problem_of(lab.examine(lab.simulate(hz=hz, seconds=SECONDS)[0], drops=0), TWIST)
    done = lab.simulate(hz=rate_in(problem.remedy), seconds=SECONDS)[0]
    assert lost_of(lab.examine(done, drops=0), TWIST) == problem.left == 0


@pytest.mark.quick("10")
@pytest.mark.parametrize("hz", [10, 20])
def test_subscribe_with_so_high_a_limit(lab, hz):
    problem = problem_of(lab.examine(lab.simulate(hz=hz, seconds=SECONDS)[0], drops=0), TWIST)
    limit = int(re.search(r"subscribe with a limit of (\d+)", problem.remedy)[1])
    _, counters = lab.simulate(hz=hz, seconds=SECONDS, app_msg_limit=limit)
    assert counters.msg_limits == problem.left == 0


def test_a_short_capture_of_a_steady_stream_is_no_burst(lab):
    problem = problem_of(lab.examine(lab.simulate(hz=10, seconds=8)[0], drops=0), TWIST)
    assert rate_in(problem.remedy) == 7.9


def test_send_so_slowly_that_cis_socket_never_fills(lab):
    problem = problem_of(lab.examine(lab.simulate(hz=60, seconds=SECONDS)[0], drops=0), TWIST)
    assert "subscribe" not in problem.remedy  # no limit helps where CI does not read so many
    done = lab.simulate(hz=rate_in(problem.remedy), seconds=SECONDS)[0]
    assert lost_of(lab.examine(done, drops=0), TWIST) == problem.left == 0


def generated(lab, rate, feeds=()):
    steps = (5, GENERATED, rate), (SECONDS - 5, GENERATED, 0)
    return lab.simulate(
        hz=1.0, state_hz=0.0, seconds=SECONDS, generators=steps, limits=((GENERATED, 4),), feeds=feeds
    )[0]


@pytest.mark.quick("30")
@pytest.mark.parametrize("hz", [10, 30, 60])
def test_let_telemetry_output_keep_more(lab, hz, pasted):
    found = lab.examine(generated(lab, hz), drops=0)
    problem = problem_of(found, GENERATED)
    if hz == 60:  # its pipe of 50 has no room for 30 of one MsgId beside all others and their bursts
        assert rate_in(problem.remedy) == 7.9
        done = generated(lab, 7)
    else:
        done = generated(lab, hz, pasted(found, 3, "to-remove", "to-add"))
    assert lost_of(lab.examine(done, drops=0), GENERATED) == problem.left == 0


@pytest.mark.quick("30")
@pytest.mark.parametrize("hz", [10, 30, 60])
def test_publish_at_most_so_many(lab, hz):
    problem = problem_of(lab.examine(generated(lab, hz), drops=0), GENERATED)
    done = generated(lab, int(rate_in(problem.remedy)))
    assert lost_of(lab.examine(done, drops=0), GENERATED) == problem.left == 0


@pytest.mark.long
@pytest.mark.parametrize("hz", [60, 100])
def test_publish_so_slowly_that_a_peers_pipe_never_fills(lab, hz):
    def run(rate):
        steps = (5, TO_PEER, rate), (SECONDS - 5, TO_PEER, 0)
        return lab.examine(
            lab.simulate("two-rovers", hz=0.0, state_hz=0.0, seconds=SECONDS, generators=steps)[0], drops=0
        )

    problem = problem_of(run(hz), TO_PEER)
    assert "inject" not in problem.remedy  # no command raises the limit of a peer's pipe
    assert lost_of(run(int(rate_in(problem.remedy))), TO_PEER) == problem.left == 0


@pytest.fixture(scope="module")
def twist(lab):
    """A command as the bridge sends it."""
    traffic = lab.simulate(hz=4.0, seconds=8)[0]
    return next(item.payload for item in traffic if item.destination.port == 1234 and item.payload[1] == 0x27)


def with_commands(lab, twist, times, hz=0.0):
    """Return a run with commands of another sender, as captured."""
    feeds = tuple((at, 1234, twist) for at in times)
    traffic = lab.simulate(hz=hz, seconds=SECONDS, feeds=feeds)[0]
    return lab.examine(
        lab.merged(traffic, *(lab.at(at, OTHER_BRIDGE, lab.ci, twist) for at in times)), drops=0
    )


@pytest.mark.quick("20")
@pytest.mark.parametrize("count", [20, 50])
def test_spread_a_burst(lab, twist, count):
    problem = problem_of(with_commands(lab, twist, [10 + 0.001 * at for at in range(count)]), TWIST)
    few, within_ms = map(
        int, re.search(r"spread what is sent: at most (\d+) in (\d+) ms", problem.remedy).groups()
    )
    spread = [6 + 0.001 * within_ms / few * at for at in range(count)]
    assert lost_of(with_commands(lab, twist, spread), TWIST) == problem.left == 0


def test_two_senders_share_what_one_may_send(lab, twist):
    found = with_commands(lab, twist, [5 + at / 6 for at in range(100)], hz=6.0)
    problem = problem_of(found, TWIST)
    assert rate_in(problem.remedy) == 7.9
    each = float(re.search(r"([\d.]+) Hz each of 2 senders", problem.remedy)[1])
    done = with_commands(lab, twist, [5 + at / each for at in range(int(18 * each))], hz=each)
    assert lost_of(done, TWIST) == problem.left == 0


def ordered(lab, name, argument="", feeds=(), seconds=SECONDS):
    """Return a run in which somebody sends a named command after 8 s, with that command as captured."""
    command = NAMED[name]
    data = cfe.emit_command(
        command.msg_id, command.function_code, command.payload(argument, 0), sequence_flags=0
    )
    traffic = lab.simulate(seconds=seconds, feeds=((8, 1234, data), *feeds))[0]
    sent = [lab.at(at, OTHER_BRIDGE, lab.ci, data) for at, _, data in ((8, 1234, data), *feeds)]
    return lab.merged(traffic, *sent)


def came(lab, traffic, start_s, end_s, msg_id, port):
    """Return how many of a MsgId go to a port in a time."""
    span = lab.start_ns + int(start_s * 1e9), lab.start_ns + int(end_s * 1e9)
    return sum(
        item.destination.port == port and int.from_bytes(item.payload[:2], "big") == msg_id
        for item in traffic
        if span[0] <= item.time_ns < span[1]
    )


@pytest.mark.quick("*-stop-app-TO*")
@pytest.mark.parametrize(
    ("name", "argument", "lines"),
    [
        ("es-stop-app", "EDORAS_APP", ["es-start-app"]),
        ("es-stop-app", "TO_LAB_APP", ["es-start-app", "to-enable"]),
        ("es-restart-app", "TO_LAB_APP", ["to-enable"]),
        ("to-remove", "0x0827", ["to-add"]),
    ],
    ids=lambda item: item if isinstance(item, str) else "",
)
def test_what_was_stopped_comes_again(name, argument, lines, lab, pasted):
    traffic = ordered(lab, name, argument)
    assert came(lab, traffic, 5, 8, POSE, 1235) > 1
    assert not came(lab, traffic, 16, 24, POSE, 1235)
    found = lab.examine(traffic, drops=0)
    told = {item.rule for item in found.verdicts if item.severity >= Severity.WARNING}
    assert len(told - {"crossing_loss"}) == 1  # the last two may still wait in CI's socket
    done = ordered(lab, name, argument, pasted(found, 15, *lines))
    assert came(lab, done, 17, 24, POSE, 1235) > 5


def test_no_command_starts_a_command_ingest_that_is_stopped(lab, pasted):
    found = lab.examine(ordered(lab, "es-stop-app", "CI_LAB_APP"), drops=0)
    remedies = [item.remedy for item in summarize(found).problems]
    assert any("start cFS again" in item for item in remedies)
    assert pasted(found, 15) == ()


def test_messages_are_spaced_no_more_than_needed():
    arrivals = Arrivals(np.array([0, 1, 2, 50, 51]), np.array([1, 1, 2, 1, 2]))
    spaced = arrivals.spaced(10, 1)
    assert spaced.time_ns.tolist() == [0, 2, 10, 50, 51]
    assert spaced.msg_id.tolist() == [1, 2, 1, 1, 2]
    assert arrivals.most(2) == 2
    assert Arrivals(np.zeros(0, np.int64), np.zeros(0, np.int64)).most(5) == 0


def test_a_way_loses_in_each_of_its_queues():
    arrivals = Arrivals(np.arange(20, dtype=np.int64), np.ones(20, np.int64))
    socket = Queue(100, 15, reads=10, is_socket=True)
    assert arrivals.lost((socket,), 1) == [4, 5, 5, 5]  # one may come at the time of a wake-up
    assert arrivals.lost((socket, Queue(100, 50, 4)), 1)[1:] == [5 + 6 + 1] * 3
