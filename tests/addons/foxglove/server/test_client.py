from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.frames import Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from edoras_tools.addons.foxglove.server import client as foxglove_client
from edoras_tools.addons.foxglove.server import protocol
from edoras_tools.addons.foxglove.server.client import FoxgloveClient
from edoras_tools.io.topics.messages import Records
from edoras_tools.model import Endpoint

TOPICS = 3


def records(places, size, first=0):
    """Messages on topics by their places, with their number as time."""
    count = len(places)
    start = np.arange(count) * size
    return Records(
        np.array(places, np.uint16),
        np.arange(first, first + count).astype(np.uint64),
        start,
        start + size,
        bytes(count * size),
    )


class Wire:
    """A client machine, and another WebSocket at its other end; the test carries the bytes."""

    def __init__(self, subprotocol="foxglove.sdk.v1", **options):
        self.client = FoxgloveClient(
            Endpoint("10.0.0.1", 5), **{"publishes": False, "controls": False} | options
        )
        self.other = ClientProtocol(parse_uri("ws://here"), subprotocols=[subprotocol], max_size=None)
        self.other.send_request(self.other.connect())
        (self.asked,) = self.carry()
        self.received = []

    def open(self):
        self.client.accept(TOPICS, [{"op": "first"}])
        self.take(1 << 30)
        assert self.other.state is State.OPEN
        assert self.texts() == [{"op": "first"}]
        return self

    def carry(self):
        """What the machine leaves to a server of what the other side says."""
        return [event for data in self.other.data_to_send() if data for event in self.client.receive(data)]

    def say(self, message):
        if isinstance(message, dict):
            self.other.send_text(json.dumps(message).encode())
        else:
            self.other.send_binary(message)
        return self.carry()

    def subscribe(self, *places):
        wanted = [{"id": 10 + place, "channelId": place} for place in places]
        assert not self.say({"op": "subscribe", "subscriptions": wanted})

    def take(self, most):
        """Have so many bytes taken at most; tell whether there were any."""
        data = b"".join(self.client.to_send())[:most]
        self.client.advance(len(data))
        self.other.receive_data(data)
        self.received += [item for item in self.other.events_received() if hasattr(item, "opcode")]
        return bool(data)

    def take_all(self):
        while self.take(1 << 30):
            pass

    def texts(self):
        return [json.loads(item.data) for item in self.received if item.opcode is Opcode.TEXT]

    def times(self):
        """Times of the messages that came."""
        frames = [item.data for item in self.received if item.opcode is Opcode.BINARY]
        return [int.from_bytes(data[5:13], "little") for data in frames if data[0] == 1]


def test_a_client_asks_and_is_let_in():
    wire = Wire()
    assert wire.asked == protocol.Opening(None, "", "here")
    assert not wire.client.connected
    assert wire.open().client.connected


def test_a_client_that_is_turned_away_is_told_why():
    wire = Wire()
    wire.client.refuse(503, "full")
    assert b"".join(wire.client.to_send()).endswith(b"\r\n\r\nfull\n")
    wire.take_all()
    assert wire.other.handshake_exc.response.status_code == 503
    assert wire.client.ending
    assert not wire.client.opened


actions = st.one_of(
    st.tuples(
        st.just("give"), st.lists(st.integers(0, TOPICS - 1), max_size=30), st.sampled_from([0, 90, 200])
    ),
    st.tuples(st.just("take"), st.integers(0, 3000)),
    st.tuples(st.just("subscribe"), st.integers(0, TOPICS - 1)),
    st.tuples(st.just("unsubscribe"), st.integers(0, TOPICS - 1)),
    st.tuples(st.just("time")),
)


@given(st.lists(actions, max_size=40))
def test_sent_waiting_and_dropped_are_all_there_were(steps):
    """However bytes are taken: the counts add up, what is sent has come whole, and never more waits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(foxglove_client, "MOST_MESSAGES", 20)
        patch.setattr(foxglove_client, "MOST_WAITING_BYTES", 2000)
        wire = Wire().open()
        wanted, there_were, given, now = set(), 0, [], 0
        for what, *arguments in steps:
            match what:
                case "give":
                    places, size = arguments
                    before = wire.client.dropped
                    wire.client.give(records(places, size, now))
                    ours = [now + at for at, place in enumerate(places) if place in wanted]
                    there_were += len(ours)
                    now += len(places)
                    given += ours[wire.client.dropped - before :]
                case "take":
                    wire.take(*arguments)
                case "subscribe" if arguments[0] not in wanted:
                    wire.subscribe(*arguments)
                    wanted.add(*arguments)
                case "unsubscribe":
                    wire.say({"op": "unsubscribe", "subscriptionIds": [10 + arguments[0]]})
                    wanted.discard(*arguments)
                case "time":
                    wire.client.tell_time(now)
            told = wire.client.summary()
            assert told["sent"] + told["waiting"] + told["dropped"] == there_were
            assert told["waiting"] <= 20
            assert wire.times() == given[: told["sent"]]
        wire.take_all()
        assert wire.times() == given
        assert wire.client.summary()["waiting"] == 0
        assert wire.client.summary()["bytes"] == sum(
            len(item.data) - 13
            for item in wire.received
            if item.opcode is Opcode.BINARY and item.data[0] == 1
        )


def test_one_message_may_always_wait():
    wire = Wire().open()
    wire.subscribe(0)
    wire.client.give(records([0, 0], foxglove_client.MOST_WAITING_BYTES + 1))
    assert (wire.client.summary()["waiting"], wire.client.dropped) == (1, 1)


def test_clients_that_subscribe_alike_share_frames_and_others_have_their_own():
    wires = [Wire().open() for _ in range(3)]
    for wire, places in zip(wires, [(0, 1), (0, 1), (1,)], strict=True):
        wire.subscribe(*places)
    made, shared = records([0, 1, 2, 1], 9), {}
    for wire in wires:
        wire.client.give(made, shared)
    assert len(shared) == 2
    for wire in wires:
        wire.take(1 << 30)
    first, second, other = (
        [bytes(item.data) for item in wire.received if item.data[0] == 1] for wire in wires
    )
    assert first == second
    assert [data[1] for data in first] == [10, 11, 11]
    assert other == first[1:]
    assert [wire.client.summary()["sent"] for wire in wires] == [3, 3, 2]


def test_the_latest_time_waits_and_no_other():
    wire = Wire().open()
    for time_ns in range(100):
        wire.client.tell_time(time_ns)
    wire.take(5)
    wire.client.tell_time(200)
    wire.client.tell_time(300)
    wire.take_all()
    clock = [item.data for item in wire.received if item.opcode is Opcode.BINARY]
    assert clock == [protocol.time(99), protocol.time(300)]


def test_a_client_without_playback_is_told_a_time_before_the_first():
    """Lichtblick's own formula: messages of a topic by the seconds that its clock has shown."""
    second, rate = 1_000_000_000, 59
    wire = Wire("foxglove.websocket.v1", controls=True).open()
    assert not wire.client.plays
    for number in range(3):
        wire.client.tell_time(5 * second + number * second // rate)
        wire.take_all()
    told = [item.data for item in wire.received if item.opcode is Opcode.BINARY]
    times = [int.from_bytes(item[1:9], "little") for item in told]
    assert times[:2] == [4 * second, 5 * second]
    assert all(count / ((time - times[0]) / second) < 60 for count, time in enumerate(times[1:], 1))


def test_why_a_message_is_refused_is_told_once():
    wire = Wire(publishes=True).open()
    channel = protocol.Channel(1, "/a", "x", "cdr")
    for why in ("not allowed", "not allowed", "", "not allowed", "too fast"):
        wire.client.answer(channel, why)
    wire.take_all()
    assert [item["message"] for item in wire.texts()[1:]] == ["not allowed", "not allowed", "too fast"]
    assert (wire.client.published, wire.client.refused) == (1, 4)


def test_a_client_that_asks_and_never_reads_is_disconnected():
    wire = Wire().open()
    for _ in range(foxglove_client.MOST_ANSWERS + 1):
        wire.say({"op": "nonsense"})
    assert wire.client.failed
    assert len(b"".join(wire.client.to_send())) < 1 << 20


def test_mistakes_of_a_client_are_told_to_it():
    wire = Wire(publishes=True).open()
    wire.subscribe(0)
    wire.subscribe(0)
    wire.subscribe(9)
    channel = {"id": 1, "topic": "/a", "schemaName": "x", "encoding": "cdr"}
    assert wire.say({"op": "advertise", "channels": [channel] * 2000}) == []
    assert wire.say(b"\x01\x01\x00\x00\x00data") == []
    wire.take_all()
    assert [item["message"] for item in wire.texts()[1:]] == [
        "channel 0 or subscription 10 is subscribed already",
        "there is no channel 9 to subscribe to",
        "no client may advertise more than 1000 channels",
        "channel 1 was not advertised",
    ]


def test_fragments_are_put_together_and_pings_answered():
    wire = Wire(publishes=True).open()
    channel = protocol.Channel(1, "/a", "x", "cdr")
    advertised = {"id": 1, "topic": "/a", "schemaName": "x", "encoding": "cdr"}
    assert wire.say({"op": "advertise", "channels": [advertised]}) == []
    wire.other.send_binary(b"\x01\x01\x00", fin=False)
    wire.other.send_ping(b"there?")
    wire.other.send_continuation(b"\x00\x00da", fin=False)
    wire.other.send_continuation(b"ta", fin=True)
    assert wire.carry() == [protocol.Published(channel, b"data")]
    wire.take_all()
    assert [item.data for item in wire.received if item.opcode is Opcode.PONG] == [b"there?"]


def test_goodbyes():
    wire = Wire().open()
    wire.subscribe(0)
    wire.client.give(records([0], 9))
    wire.client.close()
    wire.client.give(records([0], 9))
    wire.client.tell_time(1)
    assert not wire.client.connected
    wire.take_all()
    assert wire.times() == [0]
    assert wire.other.close_rcvd.code == 1001
    wire.carry()
    assert wire.client.ending
    wire = Wire().open()
    wire.client.receive(b"")
    assert not wire.client.connected


@given(st.lists(st.binary(max_size=64), max_size=20), st.booleans())
def test_anything_may_come(pieces, opened):
    wire = Wire()
    client = (
        wire.open().client
        if opened
        else FoxgloveClient(Endpoint("10.0.0.1", 5), publishes=True, controls=True)
    )
    for piece in pieces:
        for event in client.receive(piece) if piece else ():
            assert not isinstance(event, protocol.Opening)
