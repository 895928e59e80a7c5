"""Transcripts: what comes in, what must go out, and when."""

from __future__ import annotations

from itertools import pairwise

import pytest
from bare_cfs import BareCfs
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.apps.network_apps import SbnNode
from edoras_tools.model import Endpoint, Peer
from edoras_tools.sessions.sbn import (
    BRIDGE,
    CLIENT,
    PUBLIC_BRIDGE,
    STOCK,
    TRANSITIONS,
    AppMessage,
    Connected,
    ConnectionState,
    Disconnected,
    NotTaken,
    Refusal,
    SbnConnection,
    Trigger,
)
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn

US, CFS = Peer(0x42, 3), Peer(0x42, 1)
PROTO, SUB, UNSUB = sbn.MsgType.PROTO, sbn.MsgType.SUB, sbn.MsgType.UNSUB
HEARTBEAT, DISCONNECT, APP = sbn.MsgType.HEARTBEAT, sbn.MsgType.DISCONNECT, sbn.MsgType.APP
TWIST = cfe.emit_telemetry(0x082A, bytes(80))
TENTH = SECOND // 10
PRESETS = [STOCK, CLIENT, BRIDGE, PUBLIC_BRIDGE]


def from_cfs(msg_type, *msg_ids):
    payload = sbn.emit_subscriptions(sbn.Subscription(item) for item in msg_ids) if msg_ids else b""
    return sbn.emit(msg_type, CFS, payload)


def types(step):
    """The types of the datagrams that a call asks to send."""
    return [data[2] for data in getattr(step, "datagrams", step)]


def connection(habits, now=0, **options):
    return SbnConnection(US, [0x82A, 0x82B], habits=habits, now=now, **options)


@pytest.fixture
def client():
    return SbnConnection(US, [0x82A], now=0)


@pytest.fixture
def connected(client):
    client.service(now=0)
    client.receive_datagram(from_cfs(PROTO), now=1)
    return client


def test_a_client_asks_once_a_second_until_somebody_answers(client):
    assert types(client.service(now=0)) == [PROTO, SUB]
    assert client.next_ns == SECOND
    assert types(client.service(now=SECOND - 1)) == []
    asked = client.service(now=SECOND)
    assert types(asked) == [PROTO, SUB]
    assert sbn.parse_subscriptions(asked.datagrams[1][11:])[1] == (sbn.Subscription(0x82A),)
    assert not client.connected


def test_a_client_greets_whoever_answers_and_learns_what_is_wanted(client):
    step = client.receive_datagram(from_cfs(SUB, 0x1829, 0x182A), now=5)
    assert (types(step), step.events[0]) == ([PROTO, SUB], Connected(CFS))
    assert client.answered == CFS
    assert client.subscribed == {0x1829, 0x182A}
    assert types(client.receive_datagram(from_cfs(UNSUB, 0x182A), now=6)) == []
    assert client.subscribed == {0x1829}


def test_a_heartbeat_after_six_seconds_without_sending(connected):
    connected.sent(now=SECOND)
    assert connected.next_ns == 7 * SECOND
    assert types(connected.service(now=7 * SECOND - 1)) == []
    assert types(connected.service(now=7 * SECOND)) == [HEARTBEAT]
    assert types(connected.service(now=7 * SECOND + 1)) == []


def test_a_peer_that_is_silent_for_eleven_seconds_is_lost_and_is_asked_again(connected):
    connected.receive_datagram(from_cfs(HEARTBEAT), now=SECOND)
    connected.receive_datagram(from_cfs(SUB, 0x1829), now=SECOND)
    connected.sent(now=11 * SECOND)
    assert types(connected.service(now=12 * SECOND - 1)) == []
    assert connected.connected
    step = connected.service(now=12 * SECOND)
    assert (list(step.events), types(step)) == ([Disconnected(Trigger.TIMEOUT)], [PROTO, SUB])
    assert (connected.connected, connected.answered, connected.subscribed) == (False, None, set())


def test_a_disconnect_ends_it(connected):
    step = connected.receive_datagram(from_cfs(DISCONNECT), now=9)
    assert step == ([Disconnected(Trigger.DISCONNECT)], ())
    assert not connected.connected
    assert connected.goodbye() == []
    assert connected.receive_datagram(from_cfs(DISCONNECT), now=9) == ([], ())


def test_it_says_goodbye_where_it_is_connected(connected):
    assert types(connected.goodbye()) == [DISCONNECT]


def test_every_message_is_handed_on_and_put_in_a_datagram(connected):
    datagram = sbn.emit(APP, CFS, TWIST)
    for now in (2, 3):
        (event,) = connected.receive_datagram(datagram, now=now).events
        assert (event, event.packet) == (AppMessage(datagram), TWIST)
    assert connected.frame(TWIST) == sbn.emit(APP, US, TWIST)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", Refusal.SHORT),
        (bytes(10), Refusal.SHORT),
        (bytes.fromhex("000c0300000001") + bytes(12), Refusal.OLD_HEADER),
        (b"\xff\xff" + from_cfs(HEARTBEAT)[2:], Refusal.NEGATIVE_SIZE),
        (b"\xff\xff" + from_cfs(APP)[2:], Refusal.NEGATIVE_SIZE),
        (sbn.emit(HEARTBEAT, Peer(0x42, 9)), Refusal.OTHER_PEER),
        (from_cfs(SUB, 0x1829)[:-1], Refusal.CUT_SUBSCRIPTIONS),
    ],
)
def test_what_is_not_taken_and_why(data, reason):
    bridge = connection(BRIDGE, peer=CFS)
    bridge.receive_datagram(from_cfs(PROTO), now=1)
    (event,) = bridge.receive_datagram(data, now=2).events
    assert isinstance(event, NotTaken)
    assert event.reason is reason


@pytest.mark.parametrize(
    ("own", "announced"), [(Peer(0x42, 3), []), (Peer(0x43, 1), []), (Peer(0x43, 3), [11, 22])]
)
def test_stock_announces_to_a_peer_of_another_spacecraft_and_processor_only(own, announced):
    stock = SbnConnection(own, habits=STOCK, peer=CFS, now=0)
    heard = [second for second in range(30) if types(stock.service(now=second * SECOND))]
    assert heard == announced


def test_the_public_bridge_subscribes_every_500_ms_one_msg_id_a_datagram():
    bridge = connection(PUBLIC_BRIDGE)
    sent = [types(bridge.service(now=index * TENTH)) for index in range(11)]
    assert sent == [[SUB, SUB] if index % 5 == 0 else [] for index in range(11)]


def test_the_public_bridge_answers_when_it_polls_and_is_connected_for_good():
    bridge = connection(PUBLIC_BRIDGE)
    bridge.service(now=0)
    assert bridge.next_ns == TENTH
    assert types(bridge.receive_datagram(from_cfs(PROTO), now=5)) == []
    assert types(bridge.service(now=TENTH)) == [PROTO]
    bridge.receive_datagram(from_cfs(DISCONNECT), now=TENTH)
    for second in range(1, 30):
        bridge.service(now=second * SECOND)
    assert bridge.connected
    assert bridge.goodbye() == []


def test_the_public_bridge_answers_every_datagram_and_stops_at_the_first_that_is_no_message():
    bridge = connection(PUBLIC_BRIDGE)
    bridge.service(now=0)
    app = sbn.emit(APP, CFS, TWIST)
    for data in (app, app, from_cfs(HEARTBEAT), app):
        assert not any(isinstance(item, AppMessage) for item in bridge.receive_datagram(data, now=1).events)
    first, second = bridge.service(now=TENTH), bridge.service(now=2 * TENTH)
    assert types(first) == [PROTO, PROTO, PROTO, HEARTBEAT]
    assert first.events == [AppMessage(app), AppMessage(app)]
    assert (types(second), second.events) == ([PROTO], [AppMessage(app)])


def test_the_public_bridge_loses_lengths_below_11_modulo_256():
    bridge = connection(PUBLIC_BRIDGE)
    bridge.service(now=0)
    for size in (255, 256, 266, 267, 512):
        bridge.receive_datagram(sbn.emit(APP, CFS, bytes(size - sbn.HEADER.size)), now=1)
    events = bridge.service(now=TENTH).events
    assert [len(item.datagram) for item in events if isinstance(item, AppMessage)] == [255, 267]
    assert events.count(NotTaken(Refusal.LENGTH)) == 3


@given(st.lists(st.binary(max_size=600), max_size=20))
def test_the_public_bridge_drops_or_answers_any_datagram(datagrams):
    bridge = connection(PUBLIC_BRIDGE)
    for data in datagrams:
        bridge.receive_datagram(data, now=0)
    steps = [bridge.service(now=index * TENTH) for index in range(len(datagrams) + 1)]
    answered = sum(types(step).count(PROTO) for step in steps)
    dropped = sum(step.events.count(NotTaken(Refusal.LENGTH)) for step in steps)
    assert answered + dropped == len(datagrams)
    assert dropped == sum(len(data) % 256 < 11 for data in datagrams)


@pytest.mark.parametrize("habits", [CLIENT, BRIDGE, PUBLIC_BRIDGE])
def test_all_kinds_shake_hands_with_the_flight_side(habits):
    cfs = BareCfs()
    profile, bus = cfs.profile, cfs.bus
    pipe = bus.create_pipe("EDORAS_APP_PIPE", 32)
    bus.subscribe(pipe, 0x1829, 4)
    node = SbnNode(cfs)
    to_us = next(Endpoint(item.address, item.port) for item in profile.sbn_peers if item.peer == US)
    ours = SbnConnection(US, [0x82A], habits=habits, now=0)
    for now in range(0, 3 * SECOND, profile.sbn_wake_ns):
        waiting = list(ours.service(now=now).datagrams)
        cfs.at(now)
        while waiting:
            node.receive_datagram(waiting.pop(0))
            for _, data in cfs.take_sent():
                waiting += ours.receive_datagram(data, now=now).datagrams
        node.service()
        for to, data in cfs.take_sent():
            if to == to_us:
                ours.receive_datagram(data, now=now)
    assert node.peers[US].connected
    assert 0x82A in node.peers[US].pipe.limits
    assert ours.answered == profile.peer
    assert 0x1829 in ours.subscribed


datagrams = st.binary(max_size=80) | st.builds(
    lambda msg_type, rest: sbn.emit(msg_type, CFS, rest),
    st.sampled_from([*sbn.MsgType, 7]),
    st.binary(max_size=70),
)


@given(
    st.lists(st.tuples(st.integers(0, 12 * SECOND), datagrams | st.none()), max_size=20),
    st.sampled_from(PRESETS),
    st.sampled_from([CFS, None]),
)
def test_any_bytes_give_events_and_the_state_changes_as_the_table_says(steps, habits, peer):
    ours = connection(habits, peer=peer)
    now, states = 0, [ours.state]
    for step, data in steps:
        now += step
        for done in (
            ours.service(now=now),
            *([ours.receive_datagram(data, now=now)] if data is not None else []),
        ):
            assert all(sbn.HEADER.parse(item)["processor_id"] == 3 for item in done.datagrams)
            for event in done.events:
                states += [ConnectionState.CONNECTED] if isinstance(event, Connected) else []
                states += [ConnectionState.DISCONNECTED] if isinstance(event, Disconnected) else []
                if isinstance(event, Disconnected):
                    assert event.reason not in habits.ignores
        assert ours.state is states[-1]
    moves = {(before, after) for (before, _), after in TRANSITIONS.items()}
    assert set(pairwise(states)) <= moves
    ours.goodbye()
