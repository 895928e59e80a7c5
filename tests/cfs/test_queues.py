"""The columns against the rules taken one message at a time, and against the emulator in simulated time."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.account import Fifo
from edoras_tools.addons.lab.emulator.apps.generator import set_command
from edoras_tools.addons.lab.emulator.apps.network_apps import CommandIngest
from edoras_tools.cfs import queues
from edoras_tools.cfs.profile import TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.cfs.queues import NO_LIMIT, Queue, QueueEnd, pass_queue
from edoras_tools.model import Peer
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.cfe import msg_id_of


def one_at_a_time(queue, times, msg_ids, wakes):
    """What becomes of each message, as (outcome, when it left, when it was superseded)."""
    results = [None] * len(times)
    waiting = deque()
    wakes = deque(wakes)
    full = QueueEnd.SOCKET_FULL if queue.is_socket else QueueEnd.PIPE_OVERFLOW

    def wake_up(now):
        for _ in range(min(queue.reads, len(waiting))):
            results[waiting.popleft()] = (QueueEnd.DELIVERED, now, -1)

    for row, (time, msg_id) in enumerate(zip(times, msg_ids, strict=True)):
        while wakes and wakes[0] < time:
            wake_up(wakes.popleft())
        alike = [item for item in waiting if msg_ids[item] == msg_id]
        limit = queue.limits.get(msg_id, queue.usual_limit)
        if len(alike) >= limit:
            if queue.keeps_newest and limit:
                results[alike[0]] = (QueueEnd.SUPERSEDED, -1, time)
                waiting.remove(alike[0])
                waiting.append(row)
            else:
                results[row] = (QueueEnd.MSG_LIMIT, -1, -1)
        elif len(waiting) >= queue.depth:
            results[row] = (full, -1, -1)
        else:
            waiting.append(row)
    for now in wakes:
        wake_up(now)
    return [item or (QueueEnd.WAITING, -1, -1) for item in results]


ARRIVALS = st.lists(st.tuples(st.integers(0, 12), st.sampled_from([0x0801, 0x0827, 0x1829])), max_size=60)
LIMITS = st.one_of(st.integers(0, 5), st.just(NO_LIMIT))
QUEUES = st.fixed_dictionaries(
    {
        "round_ns": st.integers(1, 40),
        "depth": st.integers(1, 12),
        "usual_limit": LIMITS,
        "limits": st.dictionaries(st.sampled_from([0x0801, 0x0827]), LIMITS),
        "reads": st.one_of(st.integers(1, 6), st.just(NO_LIMIT)),
        "phase_ns": st.integers(-50, 50),
        "is_socket": st.booleans(),
        "keeps_newest": st.booleans(),
    }
).map(lambda values: Queue(**values))


def columns(passage):
    return list(zip(passage.outcome, passage.left_ns, passage.superseded_ns, strict=True))


@given(QUEUES, ARRIVALS)
def test_columns_are_the_same_as_one_message_at_a_time(queue, arrivals):
    times = np.cumsum([gap for gap, _ in arrivals], dtype=np.int64)
    msg_ids = [item for _, item in arrivals]
    passage = pass_queue(queue, times, np.array(msg_ids, np.int32))
    last = int(times[-1]) if arrivals else 0
    wakes = [at for at in range(queue.phase_ns - 60 * queue.round_ns, last + 3000, queue.round_ns) if at >= 0]
    assert columns(passage) == one_at_a_time(queue, times.tolist(), msg_ids, wakes)
    assert QueueEnd.WAITING not in passage.outcome


@given(QUEUES, ARRIVALS, st.lists(st.integers(0, 90), max_size=20))
def test_measured_wake_ups_leave_what_comes_after_the_last_one(queue, arrivals, gaps):
    times = np.cumsum([gap for gap, _ in arrivals], dtype=np.int64)
    msg_ids = [item for _, item in arrivals]
    wakes = np.cumsum(gaps, dtype=np.int64)
    passage = pass_queue(queue, times, np.array(msg_ids, np.int32), wakes)
    plain = one_at_a_time(queue, times.tolist(), msg_ids, wakes.tolist())
    assert columns(passage) == plain
    assert [plain[row][1] for row in passage.delivered] == sorted(
        left for outcome, left, _ in plain if outcome == QueueEnd.DELIVERED
    )
    for at in range(0, 200, 7):
        inside = [
            row
            for row, (outcome, left, superseded) in enumerate(plain)
            if times[row] <= at and (outcome == QueueEnd.WAITING or left > at or superseded > at)
        ]
        assert passage.depth(np.array([at])) == len(inside)


@given(
    st.integers(1, 5),
    st.dictionaries(st.integers(1, 3), st.integers(0, 3)),
    st.lists(st.one_of(st.none(), st.integers(1, 4)), max_size=40),
)
def test_a_fifo_keeps_the_same_rules(depth, limits, steps):
    fifo = Fifo(depth, limits)
    times, msg_ids, wakes, outcomes = [], [], [], []
    for time, step in enumerate(steps):
        if step is None:
            wakes.append(time)
            fifo.get()
        else:
            times.append(time)
            msg_ids.append(step)
            outcomes.append(fifo.put(time, step))
    queue = Queue(1, depth, limits=limits, reads=1)
    passage = pass_queue(
        queue, np.array(times, np.int64), np.array(msg_ids, np.int32), np.array(wakes, np.int64)
    )
    entered = [max(QueueEnd.WAITING, item) for item in passage.outcome]
    assert entered == outcomes
    assert len(fifo) == np.count_nonzero(passage.outcome == QueueEnd.WAITING)


def test_a_queue_that_is_read_at_once_loses_nothing():
    times = np.array([5, 5, 5, 6], np.int64)
    passage = pass_queue(Queue(0, 1, usual_limit=1), times, np.full(4, 0x1829, np.int32))
    assert columns(passage) == [(QueueEnd.DELIVERED, time, -1) for time in times]
    assert not len(pass_queue(Queue(0, 1), times[:0], np.zeros(0, np.int32)).outcome)


LATENCY_NS = 50 * MICROSECOND
EXACT = SimProfile(
    cores=64,
    latency_ns=(LATENCY_NS, LATENCY_NS),
    work_ns=0,
    housekeeping_work_ns=0,
    obey_work_ns=0,
    ci_read_ns=0,
    housekeeping_ns=3600 * SECOND,
)
"""No work and no housekeeping: each reader's period is its own and its latency, to the nanosecond."""
ENABLE = cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0"))
BRIDGE = Peer(0x42, 3)
OUTCOMES = {17: QueueEnd.MSG_LIMIT, 25: QueueEnd.PIPE_OVERFLOW}


class Watched:
    """An emulated cFS, and what was put on its bus: time, MsgId, sender, and what each pipe said."""

    def __init__(self, profile):
        self.simulation = Simulation(profile, "two-rovers", bridges=False)
        self.cfs = self.simulation.cfs
        self.publications = []
        publish = self.cfs.bus.publish

        def watch(packet, sender, *, stamp):
            pipes = {
                name: pipe for name, pipe in self.cfs.bus.pipes.items() if msg_id_of(packet) in pipe.limits
            }
            publication = publish(packet, sender, stamp=stamp)
            said = {name: QueueEnd.DELIVERED for name, pipe in pipes.items() if pipe in publication.delivered}
            for event in publication.events:
                if event.event_id in OUTCOMES:
                    said[event.values["pipe"]] = OUTCOMES[event.event_id]
            self.publications.append((self.simulation.now, msg_id_of(packet), sender, said))
            return publication

        self.cfs.bus.publish = watch

    def generate(self, msg_id, rate, start_ns, stop_ns):
        for at_ns, hz in ((start_ns, rate), (stop_ns, 0)):
            command = cfe.emit_command(0x18F0, 2, set_command(msg_id, hz))
            self.simulation.inject(at_ns, command, "CI_LAB_APP")

    def feed(self, times, endpoint, data):
        for time in times:
            self.simulation.feed(time, endpoint, data)

    def into(self, pipe):
        """Times, MsgIds and outcomes at a pipe."""
        rows = [(now, msg_id, said[pipe]) for now, msg_id, _, said in self.publications if pipe in said]
        times, msg_ids, outcomes = zip(*rows, strict=True)
        return np.array(times, np.int64), np.array(msg_ids, np.int32), list(outcomes)


def periodic(queue, wake_ns):
    """A queue with the emulator's round, one of whose wake-ups is known."""
    return replace(queue, round_ns=queue.round_ns + LATENCY_NS, phase_ns=wake_ns)


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("rate", "limit", "overflows"),
    [(7, 4, False), (20, 4, False), (333, 4, False), (80, 255, False), (120, 255, True), (1000, 49, True)],
)
def test_telemetry_outputs_pipe_is_the_emulators(rate, limit, overflows):
    profile = replace(EXACT, to_limits=TO_TABLE | {0x08F1: limit, 0x0827: 3})
    watched = Watched(profile)
    simulation = watched.simulation
    watched.feed([SECOND], watched.cfs.ci_endpoint, ENABLE)
    watched.generate(0x08F1, rate, 3 * SECOND, 9 * SECOND)
    watched.generate(0x0827, 17, 5 * SECOND + 123 * MICROSECOND, 7 * SECOND)
    sent = [item for item in simulation.run(12 * SECOND) if item.source == watched.cfs.to_endpoint]
    times, msg_ids, outcomes = watched.into("TO_LAB_TLM_PIPE")
    passage = pass_queue(periodic(queues.telemetry_pipe(profile), sent[0].time_ns), times, msg_ids)
    assert passage.outcome.tolist() == outcomes
    # What TO says when it is enabled, it says at its wake-up, behind its reading.
    sent, enabled = sent[1:], passage.left_ns[passage.delivered] > sent[0].time_ns
    assert passage.left_ns[passage.delivered][enabled].tolist() == [item.time_ns for item in sent]
    assert msg_ids[passage.delivered][enabled].tolist() == [msg_id_of(item.payload) for item in sent]
    assert QueueEnd.MSG_LIMIT in outcomes
    assert (QueueEnd.PIPE_OVERFLOW in outcomes) == overflows


@pytest.mark.each(3)
@pytest.mark.parametrize(("rate", "limit"), [(20, 8), (60, 8), (500, 64)], ids=str)
def test_a_peers_pipe_is_the_emulators(rate, limit):
    profile = replace(EXACT, sbn_peers=(SbnPeerConfig(BRIDGE, 2236),), sbn_msg_limit=limit)
    watched = Watched(profile)
    subscribe = sbn.emit(sbn.MsgType.SUB, BRIDGE, sbn.emit_subscriptions([sbn.Subscription(0x08F1)]))
    watched.feed([second * SECOND for second in range(1, 9)], watched.cfs.sbn_endpoint, subscribe)
    watched.generate(0x08F1, rate, 2 * SECOND, 8 * SECOND)
    sent = [item for item in watched.simulation.run(9 * SECOND) if item.payload[2] == sbn.MsgType.APP]
    times, msg_ids, outcomes = watched.into("SBN_3_66_Pipe")
    passage = pass_queue(periodic(queues.peer_pipe(profile), sent[0].time_ns), times, msg_ids)
    assert passage.outcome.tolist() == outcomes
    assert passage.left_ns[passage.delivered].tolist() == [item.time_ns for item in sent]
    assert (QueueEnd.MSG_LIMIT in outcomes, QueueEnd.PIPE_OVERFLOW in outcomes) == (
        rate == 60,
        rate == 500,
    )


@pytest.mark.parametrize(
    ("gap_ns", "reads", "socket"),
    [(100 * MILLISECOND, 11, 208), (20 * MILLISECOND, 11, 208), (3 * MILLISECOND, 11, 20), (1, 5, 64)],
    ids=str,
)
def test_from_ingests_socket_through_the_applications_pipe_as_in_the_emulator(
    monkeypatch, gap_ns, reads, socket
):
    profile = replace(EXACT, ci_datagrams_per_wake=reads, socket_queue=socket)
    arrivals = []
    receive = CommandIngest.receive_datagram

    def watch(self, data):
        has_room = receive(self, data)
        arrivals.append((watched.simulation.now, has_room))
        return has_room

    monkeypatch.setattr(CommandIngest, "receive_datagram", watch)
    watched = Watched(profile)
    drive = cfe.emit_command(0x1827, 1, bytes(60))
    watched.feed(range(2 * SECOND, 2 * SECOND + 300 * gap_ns, gap_ns), watched.cfs.ci_endpoint, drive)
    list(watched.simulation.run(60 * SECOND))
    ingested = [now for now, _, sender, _ in watched.publications if sender == "CI_LAB_APP"]
    times = np.array([now for now, _ in arrivals], np.int64)
    msg_ids = np.full(len(times), 0x1827, np.int32)
    at_socket = pass_queue(periodic(queues.ci_socket(profile), ingested[0]), times, msg_ids)
    assert [item != QueueEnd.SOCKET_FULL for item in at_socket.outcome] == [room for _, room in arrivals]
    assert at_socket.left_ns[at_socket.delivered].tolist() == ingested

    pipe = next(iter(watched.publications[-1][3]))
    pipe_times, pipe_ids, outcomes = watched.into(pipe)
    left_ns = at_socket.left_ns[at_socket.delivered]
    at_pipe = pass_queue(
        periodic(queues.application_pipe(profile), ingested[0]), left_ns, msg_ids[at_socket.delivered]
    )
    own = pipe_ids == 0x1827
    assert at_pipe.outcome.tolist() == [item for item, ours in zip(outcomes, own, strict=True) if ours]
    assert pipe_times[own].tolist() == left_ns.tolist()
    assert (QueueEnd.SOCKET_FULL in at_socket.outcome) == (socket < 208)
    assert (QueueEnd.MSG_LIMIT in at_pipe.outcome) == (gap_ns < 100 * MILLISECOND or reads > 8)
