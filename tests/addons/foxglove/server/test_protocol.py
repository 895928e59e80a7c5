from __future__ import annotations

import json
import struct
from contextlib import suppress

import foxglove
import foxglove_client as peer
import numpy as np
import pytest
from foxglove import websocket
from hypothesis import given
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.frames import Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from edoras_tools.addons.foxglove.server import protocol
from edoras_tools.addons.foxglove.server.protocol import PlaybackRequest, PlaybackState, Publisher
from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.errors import WireError
from edoras_tools.io.topics.messages import Records
from edoras_tools.io.topics.streams import Topic
from edoras_tools.model import Endpoint
from edoras_tools.ros import TypeStore

STRING = "std_msgs/msg/String"
CONTROL = struct.pack("<BBf?QI", 3, 1, 2.5, True, 77, 2) + b"id"
TEXTS = [
    (
        {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 1}]},
        protocol.Subscribe([(7, 1)]),
    ),
    ({"op": "unsubscribe", "subscriptionIds": [7, 8]}, protocol.Unsubscribe([7, 8])),
    (
        {"op": "advertise", "channels": [{"id": 3, "topic": "/a", "encoding": "cdr", "schemaName": STRING}]},
        protocol.Advertise([protocol.Channel(3, "/a", STRING, "cdr")]),
    ),
    ({"op": "unadvertise", "channelIds": [3]}, protocol.Unadvertise([3])),
]


@pytest.mark.parametrize(("said", "request_"), TEXTS)
def test_texts_are_read(said, request_):
    assert protocol.read_request(json.dumps(said).encode(), text=True) == request_


def test_binary_messages_are_read():
    assert protocol.read_request(b"\x01\x02\x00\x00\x00data", text=False) == protocol.Publish(2, b"data")
    asked = PlaybackRequest(playing=False, speed=2.5, seek_ns=77)
    assert protocol.read_request(CONTROL, text=False) == protocol.Control(asked, "id")


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (b"{", "not understood: JSONDecodeError"),
        (b"[]", "not understood: TypeError"),
        (b"[" * 100_000, "not understood: RecursionError"),
        (b'{"op": 1}', "'1' is not text"),
        (b'{"op": "subscribe"}', "not understood: KeyError 'subscriptions'"),
        (
            b'{"op": "unsubscribe", "subscriptionIds": [4294967296]}',
            "'4294967296' is not a 32-bit number",
        ),
        (b'{"op": "unsubscribe", "subscriptionIds": [true]}', "'True' is not a 32-bit number"),
        (b'{"op": "getParameters"}', "this server does not support getParameters"),
    ],
)
def test_what_is_no_request_is_one_line(message, why):
    with pytest.raises(WireError) as caught:
        protocol.read_request(message, text=True)
    assert why in str(caught.value)


@pytest.mark.parametrize(
    "message", [b"", b"\x02", b"\x01\x00", CONTROL[:-1], CONTROL + b"x", b"\x03\x02" + CONTROL[2:]]
)
def test_binary_garbage_is_one_line(message):
    with pytest.raises(WireError):
        protocol.read_request(message, text=False)


words = st.sampled_from(
    ["op", "subscribe", "advertise", "channels", "subscriptions", "id", "channelId", "topic"]
)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | words | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=5),
    max_leaves=12,
)


@given(st.binary(max_size=60) | values.map(lambda value: json.dumps(value).encode()), st.booleans())
def test_any_message_is_a_request_or_an_error(message, text):
    with suppress(WireError):
        assert isinstance(protocol.read_request(message, text=text), protocol.Request)


sizes = st.sampled_from([0, 1, 111, 112, 113, 114, 200, 65521, 65522, 65523, 65524, 70_000])


@given(st.lists(sizes, min_size=1, max_size=12), st.data())
def test_another_websocket_reads_the_frames(lengths, data):
    """The client side of ``websockets`` reads them as messages of the protocol, and where each ends."""
    body = bytes(range(256)) * 300
    start = np.cumsum([0, *lengths[:-1]]) % 200
    count = len(lengths)
    records = Records(
        np.zeros(count, np.uint16), np.arange(count).astype(np.uint64) << 40, start, start + lengths, body
    )
    rows = np.array(sorted(data.draw(st.sets(st.integers(0, count - 1), min_size=1))))
    frames, ends = protocol.message_frames(records, rows, rows + (1 << 31))
    reader = ClientProtocol(parse_uri("ws://here"), state=State.OPEN, max_size=None)
    for place, (first, last) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        reader.receive_data(frames[first:last].tobytes())
        (frame,) = reader.events_received()
        row = int(rows[place])
        head = struct.pack("<BIQ", 1, row + (1 << 31), row << 40)
        assert (frame.opcode, frame.fin) == (Opcode.BINARY, True)
        assert frame.data == head + body[start[row] : start[row] + lengths[row]]


class Player:
    range_ns = (1_000_000_001, 5_000_000_000)
    state = PlaybackState("Paused", 1_000_000_001, 1.5)
    waiting = False

    def control(self, request):
        return PlaybackState("Playing", request.seek_ns, request.speed, seeked=True)


class Listener:
    def on_subscribe(self, *_):
        pass

    on_unsubscribe = on_subscribe

    def on_playback_control_request(self, request):
        return websocket.PlaybackState(
            status=websocket.PlaybackStatus.Playing,
            current_time=request.seek_time,
            playback_speed=request.playback_speed,
            did_seek=True,
            request_id=request.request_id,
        )


def test_foxgloves_own_server_says_the_same(types):
    """The SDK's server, offered the same topics, is the judge of every kind of message."""
    topics = [Topic("/a", STRING, {"link": "CI"}), Topic("/b", STRING)]
    ours = FoxgloveServer(
        "x", topics, types.definition, ServerOptions(Endpoint("127.0.0.1", 0), player=Player())
    )
    context = foxglove.Context()
    schema = foxglove.Schema(name=STRING, encoding="ros2msg", data=types.definition(STRING).encode())
    channels = [
        foxglove.Channel(
            topic.name, message_encoding="cdr", schema=schema, metadata=topic.metadata, context=context
        )
        for topic in topics
    ]
    theirs = foxglove.start_server(
        name="x",
        port=0,
        context=context,
        capabilities=[websocket.Capability.Time],
        server_listener=Listener(),
        playback_time_range=Player.range_ns,
    )

    def told(url, publish, tell):
        with peer.Client(url, 2) as client:
            client.subscribe("/b")
            client.until(lambda: publish() or client.messages)
            tell()
            client.until(lambda: client.times)
            client.control(play=True, speed=2.0, seek_ns=3_000_000_000)
            client.say(op="subscribe", subscriptions=[{"id": 1, "channelId": 99}])
            client.until(lambda: client.statuses)
        client.info.pop("metadata", None)  # which library it is
        info = {**client.info, "sessionId": "", "capabilities": sorted(client.info["capabilities"])}
        offered = {topic: {**item, "id": 0} for topic, item in client.channels.items()}  # in any order
        return info, offered, client.messages[0], client.times, client.states[-1], client.statuses[0]["level"]

    one = np.ones(1, np.uint16), np.array([9], np.uint64), np.zeros(1, np.int64), np.array([4])
    try:
        assert told(
            ours.url, lambda: ours.publish(Records(*one, b"data")), lambda: ours.tell_time(5)
        ) == told(
            f"ws://127.0.0.1:{theirs.port}",
            lambda: channels[1].log(b"data", log_time=9),
            lambda: theirs.broadcast_time(5),
        )
    finally:
        ours.close()
        theirs.stop()


TWIST = "geometry_msgs/msg/Twist"
STORE = TypeStore()
CDR = STORE.encode(TWIST, {"linear": {"x": 0.5}})


def publisher():
    """A publisher of one topic, and what it took."""
    taken = []
    made = Publisher(STORE, "{} is not here".format)
    made.accept("/cmd_vel", TWIST, lambda cdr: taken.append(cdr) or "")
    return made, taken


@pytest.mark.parametrize(
    ("type_name", "encoding", "data"),
    [
        (TWIST, "cdr", CDR),
        ("geometry_msgs/Twist", "cdr", CDR),
        (TWIST, "json", json.dumps({"linear": {"x": 0.5}}).encode()),
    ],
)
def test_a_message_of_the_topics_type_is_handed_on_as_cdr(type_name, encoding, data):
    made, taken = publisher()
    assert made.topics == ["/cmd_vel"]
    assert made.publish("/cmd_vel", type_name, encoding, data) == ""
    assert taken == [CDR]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (("/other", TWIST, "cdr", CDR), "/other is not here"),
        (("/cmd_vel", "std_msgs/String", "cdr", CDR), f"/cmd_vel has type {TWIST}, not std_msgs/String"),
        (("/cmd_vel", "", "cdr", CDR), f"/cmd_vel has type {TWIST}, not a type without name"),
        (("/cmd_vel", TWIST, "ros1", CDR), "/cmd_vel: ros1 is not understood; publish cdr or json"),
        (("/cmd_vel", TWIST, "cdr", CDR[:20]), "/cmd_vel: "),
        (("/cmd_vel", TWIST, "json", b"{"), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"\xff"), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"[" * 100_000), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"[]"), "/cmd_vel: a message must be a JSON object"),
        (("/cmd_vel", TWIST, "json", b'{"speed": 1}'), "speed"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(message, why):
    made, taken = publisher()
    told = made.publish(*message)
    assert why in told
    assert "\n" not in told
    assert not taken


def test_who_takes_messages_may_refuse_one():
    made, _ = publisher()
    made.accept("/full", TWIST, lambda _: "no room")
    assert made.publish("/full", TWIST, "cdr", CDR) == "no room"


@given(st.text(max_size=20), st.sampled_from(["cdr", "json", "x"]), st.binary(max_size=100))
def test_anything_may_be_published_and_only_messages_are_taken(type_name, encoding, data):
    for name in (type_name, TWIST):
        made, taken = publisher()
        assert bool(made.publish("/cmd_vel", name, encoding, data)) != bool(taken)
