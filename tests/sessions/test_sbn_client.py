"""Transcripts: what comes in, what must go out, and when."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.profile import SECOND, SimProfile
from edoras_tools.sessions.sbn_client import BridgeClient, SbnClient
from edoras_tools.sessions.sbn_peer import SbnNode
from edoras_tools.sessions.software_bus import SoftwareBus
from edoras_tools.wire import sbn

US, CFS = sbn.Peer(0x42, 3), sbn.Peer(0x42, 1)
PROTO, SUB, UNSUB = sbn.MsgType.PROTO, sbn.MsgType.SUB, sbn.MsgType.UNSUB
HEARTBEAT, DISCONNECT = sbn.MsgType.HEARTBEAT, sbn.MsgType.DISCONNECT


def from_cfs(kind, *msg_ids):
    payload = sbn.emit_subscriptions(sbn.Subscription(item) for item in msg_ids) if msg_ids else b""
    return sbn.emit(kind, CFS, payload)


def kinds(datagrams):
    return [data[2] for data in datagrams]


@pytest.fixture
def client():
    return SbnClient(US, [0x82A], now=0)


@pytest.fixture
def connected(client):
    client.service(now=0)
    client.receive_datagram(from_cfs(PROTO), now=1)
    return client


def test_it_asks_once_a_second_until_somebody_answers(client):
    assert kinds(client.service(now=0)) == [PROTO, SUB]
    assert client.next_ns == SECOND
    assert client.service(now=SECOND - 1) == []
    asked = client.service(now=SECOND)
    assert kinds(asked) == [PROTO, SUB]
    assert sbn.parse_subscriptions(asked[1][11:])[1] == (sbn.Subscription(0x82A),)
    assert not client.connected


def test_it_greets_whoever_answers_and_learns_what_is_wanted(client):
    assert kinds(client.receive_datagram(from_cfs(SUB, 0x1829, 0x182A), now=5)) == [PROTO, SUB]
    assert client.answered == CFS
    assert client.subscribed == {0x1829, 0x182A}
    assert client.receive_datagram(from_cfs(UNSUB, 0x182A), now=6) == []
    assert client.subscribed == {0x1829}


def test_a_heartbeat_after_six_seconds_of_silence_of_its_own(connected):
    connected.sent(now=SECOND)
    assert connected.next_ns == 7 * SECOND
    assert connected.service(now=7 * SECOND - 1) == []
    assert kinds(connected.service(now=7 * SECOND)) == [HEARTBEAT]
    assert connected.service(now=7 * SECOND + 1) == []


def test_a_peer_that_is_silent_for_eleven_seconds_is_gone_and_is_asked_again(connected):
    connected.receive_datagram(from_cfs(HEARTBEAT), now=SECOND)
    connected.receive_datagram(from_cfs(SUB, 0x1829), now=SECOND)
    connected.sent(now=11 * SECOND)
    assert connected.service(now=12 * SECOND - 1) == []
    assert connected.connected
    assert connected.service(now=12 * SECOND) == []
    assert (connected.connected, connected.losses, connected.subscribed) == (False, 1, set())
    assert kinds(connected.service(now=12 * SECOND)) == [PROTO, SUB]


def test_a_goodbye_ends_it(connected):
    assert connected.receive_datagram(from_cfs(DISCONNECT), now=9) == []
    assert not connected.connected
    assert connected.goodbye() == []


def test_it_says_goodbye_where_it_is_connected(connected):
    assert kinds(connected.goodbye()) == [DISCONNECT]


def test_the_bridge_subscribes_without_end_and_answers_with_a_proto():
    bridge = BridgeClient(US, [0x82A, 0x82B], now=0)
    assert kinds(bridge.service(now=0)) == [SUB, SUB]
    assert bridge.next_ns == SECOND // 10
    assert bridge.receive_datagram(from_cfs(PROTO), now=5) == []
    assert kinds(bridge.service(now=SECOND // 10)) == [PROTO]
    assert bridge.connected
    for tenth in range(2, 5):
        assert bridge.service(now=tenth * SECOND // 10) == []
    assert kinds(bridge.service(now=SECOND // 2)) == [SUB, SUB]
    assert bridge.goodbye() == []


@pytest.mark.parametrize("kind", [SbnClient, BridgeClient])
def test_both_kinds_shake_hands_with_the_flight_side(kind):
    profile = SimProfile()
    bus = SoftwareBus(profile)
    pipe = bus.create_pipe("EDORAS_APP_PIPE", 32)
    bus.subscribe(pipe, 0x1829, 4)
    node = SbnNode(profile, bus, now=0)
    client = kind(US, [0x82A], now=0)
    now = 0
    while now < 3 * SECOND:
        out = client.service(now=now)
        for data in out:
            for item in node.receive_datagram(data, now=now).sends:
                client.receive_datagram(item.data, now=now)
        for item in node.service(now=now).sends:
            if item.peer.peer == US:
                client.receive_datagram(item.data, now=now)
        now += profile.sbn_wake_ns
    assert node.peers[US].connected
    assert 0x82A in node.peers[US].pipe.limits
    assert client.answered == profile.peer
    assert 0x1829 in client.subscribed


@given(st.lists(st.binary(max_size=80), max_size=20), st.sampled_from([SbnClient, BridgeClient]))
def test_garbage_in_nothing_but_datagrams_out(datagrams, kind):
    client = kind(US, [0x82A], now=0)
    for index, data in enumerate(datagrams):
        answers = client.receive_datagram(data, now=index) + client.service(now=index * SECOND)
        assert all(sbn.HEADER.parse(item)["processor_id"] == 3 for item in answers)
    client.goodbye()
