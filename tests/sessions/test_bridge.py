"""A bridge as a transcript: what comes from ROS and from cFS, what goes out, what is held or refused."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Handling, Route
from edoras_tools.model import Peer
from edoras_tools.sessions.bridge import (
    BridgeOptions,
    BridgeSession,
    FlightSession,
    GroundSession,
    Limit,
    Limiter,
    PacketWriter,
    Traffic,
)
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, envelope, sbn


def run(limiter, offers, until):
    """Offer (time, lane, item) in turn, serving what is due in between; return those that left, and when."""
    left = []

    def serve(end):
        while (due := limiter.next_ns) is not None and due <= end:
            found = limiter.due(now=due)
            assert found
            left.extend((due, lane, item) for lane, item in found)

    for now, lane, item in offers:
        serve(now)
        if limiter.offer(lane, item, now=now):
            left.append((now, lane, item))
    serve(until)
    return left


def at(rate_hz, seconds, lane=0):
    return [(int(index * SECOND / rate_hz), lane, index) for index in range(int(rate_hz * seconds))]


def test_without_a_limit_all_goes_on():
    limiter = Limiter([Limit()])
    assert len(run(limiter, at(10_000, 1), SECOND)) == 10_000
    assert (limiter.held, limiter.next_ns) == ([0], None)


def test_the_first_goes_and_what_is_too_much_is_dropped():
    limiter = Limiter([Limit(2, "first")])
    second = SECOND // 2
    assert limiter.offer(0, "a", now=0)
    assert not limiter.offer(0, "b", now=second - 1)
    assert limiter.next_ns is None
    assert limiter.offer(0, "c", now=second)
    assert limiter.held == [1]


def test_the_latest_waits_for_its_time_and_takes_the_place_of_older_ones():
    limiter = Limiter([Limit(2, "latest")])
    assert limiter.offer(0, "a", now=0)
    assert not limiter.offer(0, "b", now=1)
    assert not limiter.offer(0, "c", now=2)
    assert (limiter.next_ns, limiter.waits(0)) == (SECOND // 2, True)
    assert limiter.due(now=SECOND // 2 - 1) == []
    assert limiter.due(now=SECOND // 2) == [(0, "c")]
    assert (limiter.held, limiter.next_ns, limiter.waits(0)) == ([1], None, False)


@pytest.mark.parametrize("keep", ["latest", "first"])
def test_250_hz_under_a_limit_of_30_are_30(keep):
    limiter = Limiter([Limit(30, keep)])
    left = run(limiter, at(250, 10), 10 * SECOND)
    assert len(left) in {300, 301}
    assert min(b[0] - a[0] for a, b in pairwise(left)) >= 28 * MILLISECOND
    assert limiter.held[0] == 2500 - len(left) - limiter.waits(0)


def test_after_an_idle_while_no_two_go_at_once():
    limiter = Limiter([Limit(10, "first")])
    assert limiter.offer(0, "a", now=0)
    assert limiter.offer(0, "b", now=5 * SECOND)
    assert not limiter.offer(0, "c", now=5 * SECOND + SECOND // 11)
    assert limiter.offer(0, "d", now=5 * SECOND + SECOND // 10)


def test_a_total_is_shared_in_turn_though_one_is_far_faster():
    limiter = Limiter([Limit(), Limit(), Limit()], 30)
    offers = sorted([*at(1000, 10, 0), *at(50, 10, 1), *at(20, 10, 2)])
    left = run(limiter, offers, 10 * SECOND)
    lanes = [lane for _, lane, _ in left]
    assert len(left) in {300, 301}
    assert all(95 <= lanes.count(lane) <= 105 for lane in range(3))


def test_a_lane_that_is_not_counted_passes_the_total_by():
    limiter = Limiter([Limit(), Limit(keep="first")], 1, [True, False])
    assert limiter.offer(0, "a", now=0)
    assert all(limiter.offer(1, "b", now=now) for now in range(100))
    assert not limiter.offer(0, "c", now=100)


limits = st.builds(Limit, st.none() | st.floats(0.5, 500), st.sampled_from(["latest", "first"]))


@given(
    st.lists(limits, min_size=1, max_size=3),
    st.none() | st.floats(0.5, 500),
    st.lists(st.tuples(st.integers(0, 20 * MILLISECOND), st.integers(0, 2)), max_size=200),
)
def test_nothing_is_lost_sight_of_and_no_limit_is_passed(lanes, total, steps):
    limiter = Limiter(lanes, total)
    now, offers = 0, []
    for index, (step, lane) in enumerate(steps):
        now += step
        offers.append((now, lane % len(lanes), index))
    left = run(limiter, offers, now + 10 * SECOND)
    assert limiter.next_ns is None
    for lane, limit in enumerate(lanes):
        mine = [item for item in left if item[1] == lane]
        came = [index for _, owner, index in offers if owner == lane]
        assert len(came) == len(mine) + limiter.held[lane]
        assert [item for *_, item in mine] == sorted(item for *_, item in mine)
        if came and limit.keep == "latest":
            assert mine[-1][2] == came[-1]  # the last word is heard
        keeps_within([time for time, *_ in mine], limit.rate_hz)
    keeps_within([time for time, *_ in left], total)


def keeps_within(times, rate_hz):
    if rate_hz is None:
        return
    period = round(SECOND / rate_hz)
    assert all(b - a >= period // 2 for a, b in pairwise(times))
    for first in range(len(times)):
        for last in range(first, len(times)):
            assert last - first <= (times[last] - times[first]) / period + 1


US, CFS = Peer(0x42, 3), Peer(0x42, 1)
TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
CDR = bytes.fromhex("00010000") + bytes(range(48))
DRIVE = Route("/cmd_vel", TWIST, 0x1827, CI, "command")
SEEN = Route("/pose", POSE, 0x0827, TO, "telemetry")


def ground(*routes, **habits):
    writer = PacketWriter()
    return BridgeSession(
        routes or (DRIVE, SEEN),
        GroundSession(writer, None, now=0),
        writer,
        BridgeOptions(**habits),
        {TWIST: 52},
    )


def flight(*routes):
    writer = PacketWriter()
    link = FlightSession(US, CFS, [route.msg_id for route in routes if not route.to_cfs], now=0)
    return BridgeSession(routes, link, writer)


def with_handling(route, **values):
    return replace(route, handling=Handling(**values))


def sent(bridge):
    out, bridge.outbox = bridge.outbox, []
    return out


def telemetry(cdr, msg_id=0x0827, padding=0):
    return cfe.emit_telemetry(msg_id, envelope.DEFAULT.emit(cdr) + bytes(padding))


def counts(bridge, index):
    row = bridge.summary()["routes"][index]
    return row["in"], row["out"], row["held"], row["waiting"], row["refused"]


def test_a_message_becomes_the_command_that_the_public_bridge_sends():
    bridge = ground()
    assert bridge.receive_message(0, CDR, now=5)
    assert sent(bridge) == [
        cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(CDR), sequence_flags=0, with_checksum=False)
    ]
    assert counts(bridge, 0) == (1, 1, 0, 0, {})


def test_telemetry_is_cut_at_its_envelope_and_not_looked_into():
    bridge = ground()
    other = bytes.fromhex("00000000") + b"big-endian, of any length"
    assert bridge.receive_datagram(telemetry(other, padding=60), now=5) == (1, other)
    assert counts(bridge, 1) == (1, 1, 0, 0, {})


def test_what_is_not_ours_is_counted():
    bridge = ground()
    assert bridge.receive_datagram(cfe.emit_telemetry(0x0800, bytes(20)), now=5) is None
    assert bridge.receive_datagram(b"\x08\x27", now=5) is None
    assert bridge.receive_datagram(telemetry(CDR)[:30], now=5) is None
    assert (bridge.others, bridge.unreadable) == (1, 1)
    assert counts(bridge, 1) == (1, 0, 0, 0, {"cut inside the envelope": 1})


def test_an_envelope_that_lies_is_refused():
    bridge = ground()
    data = bytearray(telemetry(CDR))
    data[16:24] = (1 << 63).to_bytes(8, "little")
    assert bridge.receive_datagram(bytes(data), now=5) is None
    assert counts(bridge, 1)[4] == {"the envelope's length exceeds the packet": 1}


def test_two_sides_that_mean_different_types_are_told_apart_by_size():
    bridge = ground(replace(SEEN, type=TWIST))
    assert bridge.receive_datagram(telemetry(CDR + bytes(16)), now=5) is None
    assert counts(bridge, 0)[4] == {f"not the 52 bytes of a {TWIST}": 1}


@pytest.mark.parametrize(
    ("habits", "cdr", "reason"),
    [
        ({"max_size": 75}, CDR, "longer than the 51 bytes of CDR that fit a packet"),
        ({}, bytes(40000), "longer than the 32743 bytes of CDR that fit a packet"),
        ({"envelope": "1/1"}, bytes(256), "longer than the 255 bytes of CDR that fit a packet"),
        ({}, b"\0\1\0", "no CDR"),
    ],
)
def test_what_cannot_be_sent_is_refused(habits, cdr, reason):
    bridge = ground(**habits)
    assert not bridge.receive_message(0, cdr, now=5)
    assert (sent(bridge), counts(bridge, 0)[4]) == ([], {reason: 1})


def test_the_longest_that_fits_is_sent():
    bridge = ground(max_size=76)
    assert bridge.receive_message(0, CDR, now=5)


def test_a_route_s_own_envelope_comes_first():
    bridge = ground(replace(DRIVE, envelope="4/4 be"), replace(SEEN, envelope="auto"), envelope="1/1")
    bridge.receive_message(0, CDR, now=5)
    assert sent(bridge)[0][8:] == (52).to_bytes(4, "big") * 2 + CDR
    assert bridge.receive_datagram(telemetry(CDR), now=5) == (1, CDR)


def test_250_hz_of_state_go_out_at_30():
    bridge = ground(with_handling(DRIVE, max_rate=30.0))
    out = 0
    for index in range(2500):
        now = index * SECOND // 250
        while bridge.next_ns is not None and bridge.next_ns <= now:
            assert bridge.service(now=bridge.next_ns) == []
        bridge.receive_message(0, CDR, now=now)
        out += len(sent(bridge))
    assert out in {300, 301}
    assert counts(bridge, 0) == (2500, out, 2500 - out - 1, 1, {})


def test_what_comes_from_cfs_is_limited_where_it_asks_for_it_and_leaves_later():
    bridge = ground(with_handling(SEEN, max_rate=1.0), max_rate_total=1.0)
    first, second = CDR, CDR[::-1].replace(b"\x2f", b"\0")
    assert bridge.receive_datagram(telemetry(first), now=0) == (0, first)
    assert bridge.receive_datagram(telemetry(b"\0\1\0\0" + second), now=1) is None
    assert bridge.next_ns == SECOND
    assert bridge.service(now=SECOND) == [(0, b"\0\1\0\0" + second)]
    bridge.not_published(0, "the graph is gone")
    assert counts(bridge, 0) == (2, 1, 0, 0, {"the graph is gone": 1})


STATE = Route("/robot/pose", POSE, 0x1829, SBN, "command")
ORDER = Route("/robot/cmd_vel", TWIST, 0x082A, SBN, "telemetry")


def test_a_flight_bridge_sends_nothing_before_it_is_connected():
    bridge = flight(STATE, ORDER)
    assert not bridge.receive_message(0, CDR, now=0)
    bridge.service(now=0)
    assert [data[2] for data in sent(bridge)] == [sbn.MsgType.DISCONNECT, sbn.MsgType.PROTO]
    bridge.receive_datagram(sbn.emit(sbn.MsgType.PROTO, CFS, sbn.emit_proto()), now=1)
    assert [data[2] for data in sent(bridge)] == [sbn.MsgType.PROTO, sbn.MsgType.SUB]
    assert bridge.receive_message(0, CDR, now=2)
    packet = cfe.emit_command(0x1829, 1, envelope.DEFAULT.emit(CDR), sequence_flags=0, with_checksum=False)
    assert sent(bridge) == [sbn.emit(sbn.MsgType.APP, US, packet)]
    assert counts(bridge, 0) == (2, 1, 0, 0, {"cFS is not connected": 1})
    order = sbn.emit(sbn.MsgType.APP, CFS, telemetry(CDR, 0x082A, padding=4))
    assert bridge.receive_datagram(order, now=3) == (1, CDR)
    bridge.goodbye()
    assert [data[2] for data in sent(bridge)] == [sbn.MsgType.UNSUB, sbn.MsgType.DISCONNECT]


def test_what_waited_while_the_connection_went_is_refused():
    bridge = flight(with_handling(STATE, max_rate=1.0))
    bridge.receive_datagram(sbn.emit(sbn.MsgType.PROTO, CFS, sbn.emit_proto()), now=0)
    assert bridge.receive_message(0, CDR, now=0)
    assert not bridge.receive_message(0, CDR, now=1)
    bridge.receive_datagram(sbn.emit(sbn.MsgType.DISCONNECT, CFS), now=2)
    bridge.service(now=SECOND)
    assert counts(bridge, 0) == (2, 1, 0, 0, {"cFS is not connected": 1})


def test_the_next_deadline_is_the_earlier_of_the_two():
    bridge = ground(with_handling(DRIVE, max_rate=1.0))
    assert bridge.next_ns is None
    bridge.receive_message(0, CDR, now=0)
    bridge.receive_message(0, CDR, now=1)
    assert bridge.next_ns == SECOND
    assert flight(STATE).next_ns == 0


@given(
    st.lists(st.tuples(st.sampled_from(["ros", "cfs", "time"]), st.binary(max_size=120)), max_size=60),
    st.sampled_from(["ground", "flight"]),
    st.none() | st.floats(1, 100),
)
def test_every_message_is_somewhere_whatever_comes(steps, kind, rate):
    routes = [with_handling(STATE, max_rate=rate), with_handling(ORDER, max_rate=rate)]
    bridge = ground(*routes) if kind == "ground" else flight(*routes)
    bridge.receive_datagram(sbn.emit(sbn.MsgType.PROTO, CFS, sbn.emit_proto()), now=0)
    now = published = 0
    for what, data in steps:
        now += SECOND // 50
        if what == "ros":
            bridge.receive_message(0, data, now=now)
        elif what == "cfs":
            framed = data if len(data) % 2 else telemetry(data, 0x082A)
            found = bridge.receive_datagram(
                framed if kind == "ground" else sbn.emit(sbn.MsgType.APP, CFS, framed), now=now
            )
            published += found is not None
        else:
            published += len(bridge.service(now=now))
    for index in range(2):
        received, given_out, held, waiting, refused = counts(bridge, index)
        assert received == given_out + held + waiting + sum(refused.values())
    assert counts(bridge, 1)[1] == published
    packets = [data for data in sent(bridge) if kind == "ground" or data[2] == sbn.MsgType.APP]
    assert len(packets) == counts(bridge, 0)[1]


@pytest.mark.each(2)
@pytest.mark.parametrize(("max_rate", "hertz"), [(30.0, 30), (None, 250)])
def test_250_hz_of_state_lose_nothing_in_cfs_only_where_they_are_limited(max_rate, hertz):
    """An SBN that polls ten times a second, four messages of a MsgId at most in the application's pipe."""
    state = with_handling(Route("/robot_1/pose", POSE, 0x1829, SBN, "command"), max_rate=max_rate)
    bridge = flight(state)
    polls = SimProfile(sbn_peers=(SbnPeerConfig(US, 2236),), sbn_polls=True, sbn_wake_ns=100 * MILLISECOND)
    simulation = Simulation(polls, "two-rovers", bridges=False)
    for time_ms in range(12_000):
        now = time_ms * MILLISECOND
        for item in simulation.run(now):
            if item.destination.port == 2236:
                bridge.receive_datagram(item.payload, now=now)
        if time_ms >= 2_000 and time_ms % 4 == 0:
            bridge.receive_message(0, CDR, now=now)
        bridge.service(now=now)
        for datagram in sent(bridge):
            simulation.feed(now, simulation.cfs.sbn_endpoint, datagram)
    received, given_out, *_, refused = counts(bridge, 0)
    assert (received, round(given_out / 10), refused) == (2500, hertz, {})
    told = {text for _, text in simulation.cfs.console if "sender SBN" in text}
    limit = "EVS Port1 66/1/CFE_SB 17: Msg Limit Err,MsgId 0x1829,pipe EDORAS_APP_PIPE,sender SBN"
    assert told == (set() if max_rate else {limit})


def test_reasons_without_end_are_counted_as_one():
    traffic = Traffic()
    for number in range(100):
        traffic.refuse(f"byte {number}")
    assert len(traffic.refused) == 17
    assert (traffic.refused["byte 15"], traffic.refused["other reasons"]) == (1, 84)
