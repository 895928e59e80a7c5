"""Random flights of the emulated cFS, and what the doctor says of them beside the emulator's own account."""

from __future__ import annotations

import random
from collections import Counter

import mutations
import pytest
from effort import examples
from hypothesis import given, settings
from scenarios import START_NS, Flight, application, examined, flights, fly, replayed, truth
from truth import bounds, sums

from edoras_tools.addons.lab.emulator import Simulation, messages
from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.simulation import WireDatagram, frames_of
from edoras_tools.cfs import command_ingest, edoras_app, telemetry_output
from edoras_tools.cfs import executive_services as es
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.diagnosis.accounting.losses import Fate
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, envelope, sbn

CAUSES = {"limit", "socket"}
HOPS = {edoras_app.PIPE, socket(SimProfile().ci_port)}
UNSURE = 0.05
"""Of what counters cover so much may be told as given way to a newer one: which of two nothing shows."""


@settings(max_examples=examples(120, 40, 3))
@given(flights())
def test_what_is_proven_was_lost_and_what_counters_cover_is_told(flight):
    simulation, sent = fly(flight)
    result, (least, most) = examined(sent), truth(simulation, sent)
    assert sums(result) == []
    proven, more = bounds(result)
    assert proven <= most
    open_ = more + sum(result.get(name) or 0 for name in ("waiting", "not_captured"))
    assert least * (1 - UNSURE) <= proven + open_


@pytest.mark.each(2)
@pytest.mark.quick("10-before", "60-by the first packet")
@pytest.mark.parametrize("enabled", ["before", "by the first packet"])
@pytest.mark.parametrize("hertz", [8, 10, 30, 60])
def test_what_a_replay_records_tells_what_was_lost(hertz, enabled):
    simulation, sent = replayed(hertz, 300, enabled_before=enabled == "before")
    result = examined(sent)
    first_ns = next(item.time_ns for item in sent if item.payload[:2] == b"\x08\x03")
    losses = [item for item in simulation.cfs.account.arrivals if item.end in LOST and item.hop in HOPS]
    # What the first 0x803 has already may be older than the recording.
    seen = sum(item.begin_ns > first_ns for item in losses)
    proven, more = bounds(result)
    assert seen <= proven + more
    assert proven <= len(losses)
    assert more <= 6
    assert bool(proven) == bool(losses) == (hertz > 8)
    assert {name for row in result["balance"] for name, lost in row["lost_by"].items() if lost} <= CAUSES


def steady(hertz, seconds, quiet, **constants):
    """Return a rover flight with commands at one rate, all of it captured from the first command on."""
    return Flight("rover", SimProfile(**constants), hertz, 0.0, seconds, quiet, ())


def lost_by(result):
    found = Counter()
    for row in result["balance"]:
        found.update({cause: number for cause, number in (row["lost_by"] or {}).items() if number})
    return found


@pytest.mark.quick("3-80")
@pytest.mark.parametrize(("quiet", "hertz"), [(20, 60), (20, 80), (3, 80)])
def test_what_a_full_socket_drops_is_told_once_ci_has_read_it(quiet, hertz):
    simulation, sent = fly(steady(hertz, 20, quiet))
    result, ends = examined(sent), simulation.cfs.account.losses()
    dropped = ends[socket(1234), 0, QueueEnd.SOCKET_FULL] + ends[socket(1234), 0, QueueEnd.PIPE_OVERFLOW]
    proven, more = bounds(result)
    assert dropped > 400
    if quiet > 10:
        assert lost_by(result)["socket"] == dropped
        assert more <= 16
        return
    # What it has not read at the end waits only as far as a socket has room; the rest is not told to wait.
    (row,) = (row for row in result["balance"] if row["hop"] == "CI" and row["msg_id"] == "0x1827")
    assert row["waiting"] <= simulation.cfs.profile.socket_queue
    assert proven < dropped <= proven + more


def test_a_socket_that_overflows_while_ci_never_comes_to_rest_is_no_network():
    """How many are lost shows only once CI has read what waits; by then the socket had long been full."""
    commands = Flight("two-rovers", SimProfile(socket_queue=256, msg_max=10), 20.0, 1.0, 40, 16, ())
    simulation, sent = fly(commands)
    dropped = simulation.cfs.account.losses()[socket(1234), 0, QueueEnd.PIPE_OVERFLOW]
    found = lost_by(examined(sent))
    assert dropped > 300
    assert found["network"] == 0
    assert 0.95 * dropped < found["socket"] <= dropped


def test_a_ci_that_reads_faster_than_assumed_lost_nothing_before_its_first_count():
    """By the assumed rate it cannot have read all since the capture began, and in the end it has."""
    profile = SimProfile(ci_wake_ns=250 * MILLISECOND, app_msg_limit=20)
    _, sent = fly(Flight("two-rovers", profile, 20.0, 0.0, 33, 8, ()))
    late = START_NS + 28 * SECOND
    result = examined([item for item in sent if item.time_ns > late or item.payload[:2] != b"\x08\x84"])
    assert lost_by(result)["network"] == 0
    assert bounds(result)[0] == 0


def test_a_ci_that_reads_faster_than_assumed_did_so_before_its_first_count_too():
    """The capture begins amid 90 commands a second, all of which it reads; its counts come every 4 s."""
    rounds = {"ci_wake_ns": 100 * MILLISECOND, "to_wake_ns": 100 * MILLISECOND, "housekeeping_ns": 4 * SECOND}
    simulation, sent = fly(Flight("two-rovers", SimProfile(app_msg_limit=20, **rounds), 45.0, 0.0, 18, 6, ()))
    result = examined([item for item in sent if item.time_ns > START_NS + 5 * SECOND // 2])
    assert lost_by(result)["network"] == 0
    assert bounds(result)[0] <= truth(simulation, sent).most


@pytest.mark.parametrize("limit", [4, 8])
def test_a_network_that_loses_commands_shows_no_limit_of_an_application(limit):
    """4 Hz, of which the network loses 3 of 10 at random, and bursts that are over the limit."""
    profile, chance = SimProfile(app_msg_limit=limit, robot_port=8585), random.Random(1)
    simulation = Simulation(profile, "rover", start_ns=START_NS, command_count=1)
    bursts = [8 + 5 * at + 0.002 * place for at in range(7) for place in range(13)]
    sent, target = [], simulation.cfs.ci_endpoint
    for at, seconds in enumerate(sorted([*(3 + at / 4 for at in range(160)), *bursts])):
        body = envelope.DEFAULT.emit(messages.twist(at / 97, 0.2))
        packet = cfe.emit_command(0x1827, 1, body, sequence_flags=0)
        sent.append(
            WireDatagram(START_NS + int(seconds * SECOND), simulation.ground.endpoint, target, packet)
        )
        if chance.random() >= 0.3:
            simulation.feed(sent[-1].time_ns, target, packet)
    sent += simulation.run(START_NS + 50 * SECOND)
    result = examined(sorted(sent, key=lambda item: item.time_ns))
    reasons = [item["reason"] for item in result["verdicts"] if item["rule"] == "app_pipe_limit"]
    assert reasons
    assert not [text for text in reasons if "(measured)" in text]


def without_a_subscriber(sent_ms):
    """Return MsgId to what is told as lost of messages sent at some times; 0x1827 is taken, unseen.

    The capture begins behind the events that name 0x18a0, and has no later ones.
    """
    simulation = Simulation(start_ns=START_NS, command_rate_hz=0.0, with_account=True)
    body = envelope.DEFAULT.emit(messages.twist(0.5, 0.1))
    before = [(2200 + at, 0x18A0) for at in range(6)]
    more = [
        WireDatagram(
            START_NS + at * MILLISECOND,
            simulation.ground.endpoint,
            simulation.cfs.ci_endpoint,
            cfe.emit_command(msg_id, edoras_app.SET, body, sequence_flags=0),
        )
        for at, msg_id in sorted([*before, *((at, msg_id) for msg_id, own in sent_ms.items() for at in own)])
    ]
    for item in more:
        simulation.feed(item.time_ns, item.destination, item.payload)
    sent = [*simulation.run(more[-1].time_ns + 10 * SECOND), *more]
    sent = [item for item in sent if item.time_ns > START_NS + 5 * SECOND and item.payload[:2] != b"\x08\x08"]
    return lost_by_msg_id(examined(sorted(sent, key=lambda item: item.time_ns)))


def lost_by_msg_id(result):
    return {row["msg_id"]: row["lost"] for row in result["balance"] if row["lost"]}


def test_one_message_in_each_round_is_not_told_to_be_what_nobody_took():
    """Both fit the count: 100 in 100 rounds, and 100 in 50 rounds, of which nobody takes any."""
    pairs = [6130 + 1000 * at + more for at in range(50) for more in (0, 10)]
    assert "0x1827" not in without_a_subscriber({0x1827: range(6040, 56040, 500), 0x18A0: pairs})


@pytest.mark.parametrize(("first", "other"), [(6130, 32040), (65130, 6040)])
def test_what_nobody_took_is_told_beside_as_many_rounds_at_another_time(first, other):
    bursts = [first + 1000 * at + 10 * more for at in range(20) for more in range(5)]
    sent_ms = {0x1827: range(other, other + 50_000, 500), 0x18A0: bursts}
    assert without_a_subscriber(sent_ms) == {"0x18a0": 100}


@pytest.mark.parametrize("number", [4, 40])
def test_of_many_msg_ids_that_all_have_no_subscriber_each_is_told(number):
    sent_ms = {
        0x1900 + at: [6000 + at * 40_000 // number + more for more in (0, 5, 10)] for at in range(number)
    }
    assert without_a_subscriber(sent_ms) == {f"0x{msg_id:04x}": 3 for msg_id in sent_ms}


def test_what_nobody_took_is_summed_once_and_not_for_each_msg_id(monkeypatch):
    asked, whole = Counter(), Fate.unsubscribed.fget

    def unsubscribed(fate):
        asked[fate.stream.msg_id] += 1
        return whole(fate)

    monkeypatch.setattr(Fate, "unsubscribed", property(unsubscribed))
    without_a_subscriber({0x1900 + at: [6000 + at * 1000 + more for more in (0, 5, 10)] for at in range(40)})
    assert len(asked) >= 40
    assert max(asked.values()) <= 10


@pytest.mark.parametrize(("scenario", "hertz"), [("rover", 20.0), ("arm", 30.0)])
def test_a_limit_that_nothing_shows_is_not_told_as_a_late_application(scenario, hertz):
    """Its limit is 2, and nothing comes to a robot here; at 30 Hz CI's socket is full, too."""
    _, sent = fly(Flight(scenario, SimProfile(app_msg_limit=2), hertz, 1.0, 30, 10, ()))
    remedies = [item["remedy"] for item in examined(sent)["verdicts"] if item["lost"]]
    assert len(remedies) == (2 if hertz > 22 else 1)
    assert all("send at most 7.9 Hz" in item for item in remedies)
    assert not any("see what keeps the application's task" in item for item in remedies)


def beside_a_second_peer(profile, hertz, state_hertz, *, send_hertz=0, wants=()):
    """Return a flight of two rovers with a peer more, which sends 0x1827 and gets what it subscribes to."""
    simulation = Simulation(
        profile,
        "two-rovers",
        start_ns=START_NS,
        command_rate_hz=hertz,
        state_rate_hz=state_hertz,
        command_count=int(hertz * 24),
        with_account=True,
    )
    peer, own = SbnConnection(Peer(0x42, 2), wants, now=START_NS), Endpoint(profile.address, 2235)
    first_ns, target = START_NS + 10_266 * MILLISECOND, simulation.cfs.sbn_endpoint
    fed = []
    for at in range(send_hertz * 16):
        body = envelope.DEFAULT.emit(messages.twist(at / 9, 0.2))
        packet = cfe.emit_command(0x1827, edoras_app.SET, body, sequence_flags=0)
        fed.append((first_ns + at * SECOND // send_hertz, peer.frame(packet)))
    subscribes = [sbn.emit_subscriptions([sbn.Subscription(item)]) for item in wants]
    begin = [sbn.emit(sbn.MsgType.SUB, peer.own, item) for item in subscribes]
    beats = [sbn.emit(sbn.MsgType.HEARTBEAT, peer.own, b"")] * 10
    fed += [(START_NS + (4 + 3 * at) * SECOND, data) for at, data in enumerate([*begin, *beats])]
    more = [WireDatagram(at, own, target, data) for at, data in sorted(fed)]
    for item in more:
        simulation.feed(item.time_ns, target, item.payload)
    sent = [*simulation.run(START_NS + 40 * SECOND), *more]
    return simulation, sorted(sent, key=lambda item: item.time_ns)


@pytest.mark.parametrize("msg_ids", [(0x1829,), (0x1829, 0x182A)])
def test_what_cfs_refuses_of_a_stranger_is_none_of_the_bridges_beside_it(msg_ids):
    """Its states come at 30 Hz, of which many are lost; the stranger sends the same MsgIds from 10 s on."""
    simulation = Simulation(
        SimProfile(), "two-rovers", start_ns=START_NS, command_rate_hz=2.0, state_rate_hz=30.0
    )
    peer, own = SbnConnection(Peer(0x42, 9), (), now=START_NS), Endpoint(simulation.cfs.profile.address, 2299)
    more = []
    for at in range(40):
        body = envelope.DEFAULT.emit(messages.twist(at / 9, 0.2))
        for place, msg_id in enumerate(msg_ids):
            when = START_NS + 10 * SECOND + (200 * at + 50 * place) * MILLISECOND
            data = peer.frame(cfe.emit_command(msg_id, edoras_app.SET, body, sequence_flags=0))
            more.append(WireDatagram(when, own, simulation.cfs.sbn_endpoint, data))
    for item in more:
        simulation.feed(item.time_ns, item.destination, item.payload)
    sent = sorted([*simulation.run(START_NS + 40 * SECOND), *more], key=lambda item: item.time_ns)
    rows = [row for row in examined(sent)["balance"] if (row["lost_by"] or {}).get("unknown_peer")]
    assert [(row["msg_id"], row["in"], row["lost_by"]) for row in rows] == [
        (f"0x{msg_id:04x}", 40, {"unknown_peer": 40}) for msg_id in msg_ids
    ]


@pytest.mark.each(2)
@pytest.mark.parametrize("send_hertz", [4, 8])
def test_what_comes_by_another_way_replaces_commands_too(send_hertz):
    profile = SimProfile(ci_wake_ns=250 * MILLISECOND, seed=782)
    simulation, sent = beside_a_second_peer(profile, 9.0, 1.0, send_hertz=send_hertz)
    assert simulation.cfs.account.losses()[edoras_app.PIPE, 0x1827, QueueEnd.MSG_LIMIT] == 0
    result = examined(sent)
    assert bounds(result)[0] == 0
    assert result["superseded"] > 100


def test_full_rounds_alone_show_a_peers_limit_where_other_pipes_overflow():
    profile = SimProfile(app_msg_limit=20, msg_max=20, sbn_msg_limit=2)
    simulation, sent = beside_a_second_peer(profile, 14.0, 30.0, wants=(0x829,))
    ends = simulation.cfs.account.losses()
    over = ends["SBN_2_66_Pipe", 0x829, QueueEnd.MSG_LIMIT]
    full = sum(number for (_, _, end), number in ends.items() if end is QueueEnd.PIPE_OVERFLOW)
    result = examined(sent)
    assert over > 300
    assert full > 20
    (row,) = (row for row in result["balance"] if row["hop"] == "SBN_2_66_Pipe" and row["msg_id"] == "0x0829")
    assert 0.9 * over < row["lost_by"]["limit"] <= over
    assert lost_by(result)["after"] == 0


@pytest.mark.each(2)
@pytest.mark.parametrize("seed", [3, 7])
def test_a_backlog_that_began_in_the_capture_is_no_older_one(seed):
    simulation, sent = fly(steady(45, 20, 6, seed=seed))
    result = examined(sent)
    assert set(lost_by(result)) == {"limit"}
    most = simulation.cfs.account.losses()[edoras_app.PIPE, 0x1827, QueueEnd.MSG_LIMIT]
    proven, _ = bounds(result)
    assert 0.8 * most < proven <= most


def test_what_the_first_count_may_have_had_is_a_range():
    first, cut = START_NS + 8 * SECOND, START_NS + 9 * SECOND
    simulation, sent = fly(steady(12, 20, 6))
    late = [item for item in sent if item.payload[:1] == b"\x18" or item.time_ns > cut]
    late = [item for item in late if item.time_ns > first or item.payload[:1] == b"\x18"]
    result = examined(late)
    proven, more = bounds(result)
    assert proven <= simulation.cfs.account.losses()[edoras_app.PIPE, 0x1827, QueueEnd.MSG_LIMIT]
    assert simulation.cfs.account.losses()[edoras_app.PIPE, 0x1827, QueueEnd.MSG_LIMIT] <= proven + more


@pytest.mark.long
def test_full_pipes_explain_what_only_they_count():
    other = {"to_wake_ns": 100 * MILLISECOND, "ci_wake_ns": 250 * MILLISECOND, "app_msg_limit": 2}
    limits = {**SimProfile().to_limits, 0x827: 20}
    profile = SimProfile(**other, msg_max=20, to_limits=limits)
    set_ = generator.COMMAND_MSG_ID, generator.SET
    commands = tuple((at, *set_, generator.set_command(0x827, hertz)) for at, hertz in ((8, 300), (18, 0)))
    simulation, sent = fly(Flight("rover", profile, 20.0, 0.0, 24, 6, commands))
    found, ends = lost_by(examined(sent)), simulation.cfs.account.losses()
    lost = {"limit": QueueEnd.MSG_LIMIT, "overflow": QueueEnd.PIPE_OVERFLOW}
    assert found == {
        kind: sum(number for (*_, end), number in ends.items() if end is way) for kind, way in lost.items()
    }
    assert found["overflow"] > 100


def test_a_slow_link_is_no_outage():
    """What is under way for long is counted late, not lost before cFS was up."""
    _, sent = fly(steady(4, 20, 8))
    late = [
        item._replace(time_ns=item.time_ns - (item.payload[:1] == b"\x18") * 6 * SECOND // 10)
        for item in sent
        if item.payload[:1] != b"\x18" or item.time_ns - 6 * SECOND // 10 > sent[0].time_ns - SECOND
    ]
    result = examined(sorted(late, key=lambda item: item.time_ns))
    assert bounds(result)[0] == 0


def test_a_capture_whose_commands_are_all_counted_proves_what_the_link_down_lost():
    _, sent = fly(steady(5, 40, 6))
    chosen = [at for at, item in enumerate(sent) if item.payload[:1] == b"\x08"]
    lost = set(chosen[10:-10:7])
    result = examined([item for at, item in enumerate(sent) if at not in lost])
    proven, more = bounds(result)
    assert proven == len(lost)
    assert more == 0
    assert lost_by(result) == {"after": len(lost)}


def test_a_count_that_comes_twice_is_of_no_idle_ci():
    """Without an identification nothing but the sequence count shows that 0x884 came twice."""
    _, sent = fly(steady(60, 20, 20))
    counts = [item for item in sent if item.payload[:2] == b"\x08\x84"]
    again = [item._replace(time_ns=item.time_ns + MILLISECOND) for item in counts]
    plain = examined(sent)
    result = examined(sorted([*sent, *again], key=lambda item: item.time_ns))
    assert bounds(result) == bounds(plain)
    assert lost_by(result) == lost_by(plain)
    assert lost_by(plain)["socket"] > 400


def test_two_clocks_set_within_a_round_are_no_steps_of_nothing():
    jump_s = 1_001_000
    ahead = (6.98, 0x1805, 11, jump_s.to_bytes(4, "little") + bytes(4))  # ADD_ADJUST
    _, sent = fly(Flight("two-arms", SimProfile(seed=4), 4.0, 12.0, 15, 16, (ahead,)))
    hour_ns = 3600 * SECOND
    moved = [
        item._replace(time_ns=item.time_ns + hour_ns * (item.time_ns > START_NS + 71 * SECOND // 10))
        for item in sent
    ]
    jumps = [item["reason"] for item in examined(moved)["verdicts"] if item["rule"] == "clock_jump"]
    assert jumps
    assert not [reason for reason in jumps if "by 0.0 s" in reason]


@pytest.mark.parametrize("share", [0.05, 0.1, 0.3])
def test_gaps_beside_an_overloaded_application_are_not_told_as_what_its_pipe_lost(share):
    """The network behind cFS loses telemetry while 0x803 counts commands that may have given way."""
    profile = SimProfile(to_wake_ns=500 * MILLISECOND, ci_wake_ns=250 * MILLISECOND)
    simulation, sent = fly(Flight("two-arms", profile, 20.0, 4.0, 30, 16, ()))
    chance = random.Random(share)
    telemetry = [item for item in sent if item.destination == simulation.ground.endpoint]
    lost = {id(item) for item in telemetry[200:-60] if chance.random() < share}
    result = examined([item for item in sent if id(item) not in lost])
    proven, more = bounds(result)
    least, most = (item + len(lost) for item in truth(simulation, sent))
    assert proven <= most
    assert least - 6 <= proven + more
    assert not [
        row for row in result["balance"] if row["hop"] == "TO_LAB_TLM_PIPE" and row["lost_by"].get("limit")
    ]


def test_what_ci_cannot_have_read_before_its_first_count_is_lost():
    """It may have restarted since, and read what it could; the rest was lost in its full socket."""
    simulation, sent = fly(Flight("two-rovers", SimProfile(), 60.0, 4.0, 18, 16, ()))
    first_ns = START_NS + 6 * SECOND
    kept = [item for item in sent if item.payload[:2] != b"\x08\x84" or item.time_ns > first_ns]
    dropped = simulation.cfs.account.losses()[socket(1234), 0, QueueEnd.PIPE_OVERFLOW]
    rows = [row for row in examined(kept)["balance"] if row["hop"] == "CI"]
    proven, more = (sum(row.get(name) or 0 for row in rows) for name in ("lost", "uncertain"))
    assert dropped > 500
    assert 0.9 * dropped < proven <= dropped <= proven + more


@pytest.mark.parametrize("every", [3, 7])
def test_a_count_that_comes_late_is_of_no_idle_ci(every):
    simulation, sent = fly(Flight("two-rovers", SimProfile(), 20.0, 4.0, 30, 16, ()))
    counts = [item for item in sent if item.payload[:2] == b"\x08\x84"][::every]
    late = {id(item) for item in counts}
    jittered = [
        item._replace(time_ns=item.time_ns + (id(item) in late) * 27 * SECOND // 100) for item in sent
    ]
    result = examined(sorted(jittered, key=lambda item: item.time_ns))
    proven, (_, most) = lost_by(result)["socket"], truth(simulation, sent)
    assert 0.9 * lost_by(examined(sent))["socket"] < proven
    assert proven <= simulation.cfs.account.losses()[socket(1234), 0, QueueEnd.PIPE_OVERFLOW]
    assert bounds(result)[0] <= most


@pytest.mark.parametrize("times", [(5.6, 5.9, 6.3, 6.7, 7.2), (9.9, 10.4, 10.9, 11.4)])
def test_a_count_that_was_reset_twice_need_not_fall_each_time(times):
    reset = command_ingest.COMMAND_MSG_ID, command_ingest.RESET_COUNTERS, b""
    commands = tuple((at, *reset) for at in times)
    _, sent = fly(Flight("rover", SimProfile(app_msg_limit=20), 8.0, 4.0, 24, 4, commands))
    assert bounds(examined(sent))[0] == 0


def test_sbn_that_speaks_again_runs():
    """Telemetry Output is off meanwhile, so that no event tells it, and nothing comes out."""
    commands = (
        application(9.65, es.RESTART_APP, "SBN"),
        application(12.26, es.RESTART_APP, "TO_LAB_APP"),
        application(19.6, es.STOP_APP, "SBN"),
        (20.94, telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, b"127.0.0.1".ljust(16, b"\0")),
        application(22.0, es.START_APP, "SBN"),
    )
    simulation, sent = fly(Flight("two-rovers", SimProfile(app_msg_limit=8), 12.0, 12.0, 44, 16, commands))
    found, ends = lost_by(examined(sent)), simulation.cfs.account.losses()
    assert 0.9 * ends[socket(2234), 0, QueueEnd.CLOSED] < found["stopped"]
    assert found["stopped"] <= ends[socket(2234), 0, QueueEnd.CLOSED]


def test_counts_that_commands_may_have_caused_place_no_gap_behind_cfs():
    """Telemetry Output's pipe of twelve overflows; nothing names it, and CI was restarted."""
    profile = SimProfile(app_msg_limit=4, to_pipe_depth=12, socket_queue=10, seed=633)
    restart = application(6.395409461764308, es.RESTART_APP, "CI_LAB_APP")
    simulation, sent = fly(Flight("two-rovers", profile, 9.0, 4.0, 16, 16, (restart,)))
    result = examined(sent)
    assert lost_by(result)["after"] == 0
    assert lost_by(result)["unknown"] > 10
    assert bounds(result)[0] <= truth(simulation, sent).most


def test_what_a_network_reordered_behind_cfs_is_no_loss_in_it(tmp_path):
    """Captured on both sides of a link that loses a tenth of the telemetry and holds some of it back."""
    simulation, sent = fly(Flight("two-rovers", SimProfile(app_msg_limit=4), 4.0, 30.0, 28, 6, ()))
    data, chance = frames_of(sent, 1), random.Random(0)
    near = []
    for item, at, length in zip(sent, data.offset.tolist(), data.length.tolist(), strict=True):
        frame = bytearray(bytes(12) + b"\x08\0" + bytes(data.data[at : at + length]))
        frame[18:20] = (len(near) + 1).to_bytes(2, "big")
        frame[24:26] = bytes(2)
        frame[24:26] = mutations.internet_checksum(frame[14:34]).to_bytes(2, "big")
        near.append(mutations.Frame(item.time_ns, bytes(frame), len(frame)))
    far = []
    for item in near:
        if mutations.is_to(item.data, 1235):
            held_ns = chance.randrange(400) * MILLISECOND * (chance.random() < 0.3)
            far += [item._replace(time_ns=item.time_ns + 5 * MILLISECOND + held_ns)] * (chance.random() > 0.1)
        else:
            early_ns = 5 * MILLISECOND * mutations.is_to(item.data, 1234)
            far.append(item._replace(time_ns=item.time_ns - early_ns))
    far.sort(key=lambda item: item.time_ns)
    files = [mutations.write(tmp_path / "far.pcap", far), mutations.write(tmp_path / "near.pcap", near)]
    source, _ = open_aligned(files, Settings(configs=[]))
    found = examine(source, Settings(configs=[]).workbench(source.info)).diagnosis
    lost = found.lost + found.unaccounted
    assert lost <= truth(simulation, sent).most + len(near) - len(far)


@pytest.mark.parametrize("text", [b"Stop Application SBN", b"no event is missing"])
def test_an_application_whose_way_out_is_closed_was_started_all_the_same(text):
    """SBN is commanded to start before it has ended, and stays away: what is sent on reaches nobody."""
    commands = (
        application(13.35, es.STOP_APP, "SBN"),
        application(16.35, es.START_APP, "SBN"),
        application(17.2, es.STOP_APP, "EDORAS_APP"),
        application(25.2, es.START_APP, "EDORAS_APP"),
    )
    simulation, sent = fly(
        Flight("two-arms", SimProfile(ci_wake_ns=250 * MILLISECOND), 12.0, 10.0, 44, 16, commands)
    )
    result = examined([item for item in sent if text not in item.payload])
    found = lost_by(result)
    assert found["restart_failed"] == 0
    closed = simulation.cfs.account.losses()[socket(2234), 0, QueueEnd.CLOSED]
    assert 0.9 * closed < found["stopped"]
    assert bounds(result)[0] <= truth(simulation, sent).most


@pytest.mark.parametrize(("hertz", "wake_ms"), [(9, 250), (12, 500), (20, 250)])
def test_rounds_that_sbn_sends_in_bursts_are_no_shorter(hertz, wake_ms):
    """SBN serves its peers once a second, and is stopped for good: the newest of each round is lost."""
    profile = SimProfile(ci_wake_ns=wake_ms * MILLISECOND, app_msg_limit=20, sbn_wake_ns=SECOND)
    stop = application(17.5, es.STOP_APP, "SBN")
    simulation, sent = fly(Flight("two-rovers", profile, hertz, 0.0, 33, 16, (stop,)))
    ends = simulation.cfs.account.losses()
    closed = sum(ends["software bus", msg_id, QueueEnd.CLOSED] for msg_id in (0x82A, 0x82B))
    assert abs(lost_by(examined(sent))["stopped"] - closed) <= 6


def test_a_restart_of_ci_moves_nothing_that_was_lost_long_before():
    """The capture begins amid a flood: what its backlog lost is a range, also where counts fall later."""
    answers = []
    for commands in ((), (application(36.0, es.RESTART_APP, "CI_LAB_APP"),)):
        _, sent = fly(Flight("rover", SimProfile(app_msg_limit=8, seed=3), 30.0, 4.0, 24, 90, commands))
        late = [item for item in sent if item.time_ns > START_NS + 9 * SECOND]
        answers.append(bounds(examined([item for item in late if item.destination.port in {1234, 1235}])))
    assert answers[0] == answers[1]
    assert answers[0][1] > answers[0][0]
