from __future__ import annotations

import socket
import sys

import foxglove_client as peer
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Endpoint
from edoras_tools.sinks import foxglove_server, foxglove_visitor
from edoras_tools.sinks.foxglove_offer import Offer, PlaybackRequest, PlaybackState
from edoras_tools.sinks.foxglove_server import FoxgloveServer
from edoras_tools.sinks.mcap_rows import Records
from edoras_tools.sinks.streams import Topic
from edoras_tools.websocket import Guard

STRING = "std_msgs/msg/String"
TOPICS = [Topic("/a", STRING, {"link": "ci"}), Topic("/b", STRING)]
ANY = Endpoint("127.0.0.1", 0)


def records(places, first, size):
    """Messages whose data and times say which they are, on topics by their places."""
    numbers = np.arange(first, first + len(places))
    data = b"".join(int(number).to_bytes(8, "little").ljust(size, b".") for number in numbers)
    start = np.arange(len(places)) * size
    return Records(np.array(places, np.uint16), numbers.astype(np.uint64), start, start + size, data)


@pytest.fixture
def serve(types):
    servers = []

    def start(**offer):
        made = Offer("test", {STRING: types.definition(STRING)}, **offer)
        servers.append(FoxgloveServer(made, TOPICS, ANY))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def test_topics_and_their_schemas_are_told(serve, types):
    with peer.Client(serve(session="s").url, 2) as client:
        assert client.socket.subprotocol == "foxglove.sdk.v1"
        assert client.info["name"] == "test"
        assert client.info["capabilities"] == ["time"]
        assert client.info["sessionId"] == "s"
        told = client.channels["/a"]
        assert (told["encoding"], told["schemaName"], told["schemaEncoding"]) == ("cdr", STRING, "ros2msg")
        assert told["schema"] == types.definition(STRING)
        assert told["metadata"] == {"link": "ci"}


def test_a_client_gets_what_it_subscribed_to_and_nothing_else(serve):
    server = serve()
    with peer.Client(server.url, 2) as client, peer.Client(server.url, 2) as other:
        client.subscribe("/b")
        other.subscribe("/a", "/b")
        peer.wait(lambda: server.wanted(0) and all(item.wants(1) for item in server.visitors))
        server.publish(records([0, 1, 0, 1], 10, 20))
        client.until(lambda: len(client.messages) == 2)
        other.until(lambda: len(other.messages) == 4)
        assert [(item.topic, item.time_ns, item.data[:8]) for item in client.messages] == [
            ("/b", 11, (11).to_bytes(8, "little")),
            ("/b", 13, (13).to_bytes(8, "little")),
        ]
        assert [item.topic for item in other.messages] == ["/a", "/b", "/a", "/b"]
        server.tell_time(77)
        client.until(lambda: client.times == [77])


def test_a_topic_may_come_later(serve, types):
    server = serve()
    with peer.Client(server.url, 2) as client:
        assert server.add(Topic("/late", STRING)) == 2
        client.until(lambda: "/late" in client.channels)
        client.subscribe("/late")
        peer.wait(lambda: server.wanted(2))
        server.publish(records([2], 1, 30))
        client.until(lambda: client.on("/late"))
    with peer.Client(server.url, 3) as client:
        assert "/late" in client.channels


def test_a_client_that_does_not_read_holds_up_nobody_and_its_losses_are_counted(serve):
    server = serve()
    total, size, piece = 100_000, 104, 2000
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    narrow.connect((server.endpoint.address, server.endpoint.port))
    with peer.Client(server.url, 2) as quick, peer.Client(server.url, 2, sock=narrow, max_queue=1) as slow:
        quick.subscribe("/a")
        slow.subscribe("/a")
        peer.wait(lambda: len(server.visitors) == 2 and all(item.wants(0) for item in server.visitors))
        for first in range(0, total, piece):
            server.publish(records([0] * piece, first, size))
            while len(quick.messages) < first + piece:
                assert quick.take()
        assert [item.time_ns for item in quick.messages] == list(range(total))

        def row(client):
            address = str(Endpoint(*client.socket.socket.getsockname()[:2]))
            return next(item for item in server.summary()["clients"] if item["address"] == address)

        peer.wait(lambda: row(quick)["sent"] == total)  # counted once it is on its way
        assert row(quick)["dropped"] == 0
        dropped = row(slow)["dropped"]
        assert dropped > total // 2
        assert 0 <= total - dropped - row(slow)["sent"] <= foxglove_visitor.ROOM
        # Once it reads, it gets what waited, and every message is accounted for.
        slow.until(lambda: len(slow.messages) == total - dropped)
        server.publish(records([0], total, size))
        slow.until(lambda: slow.messages[-1].time_ns == total)
        peer.wait(lambda: row(slow)["sent"] == len(slow.messages) == total + 1 - dropped)
        assert row(slow)["dropped"] == dropped


def test_no_more_bytes_wait_than_there_is_room_for(serve, monkeypatch):
    monkeypatch.setattr(foxglove_visitor, "ROOM_BYTES", 100_000)
    server = serve()
    with peer.Client(server.url, 2) as client:
        client.subscribe("/a")
        peer.wait(lambda: server.wanted(0))
        server.publish(records([0] * 50, 0, 10_000))
        client.until(lambda: len(client.messages) == 10)
        assert [item.time_ns for item in client.messages] == list(range(40, 50))
        peer.wait(lambda: server.summary()["sent"] == 10)
        # One message may always wait, however large it is.
        server.publish(records([0], 50, 300_000))
        client.until(lambda: client.messages[-1].time_ns == 50)
        assert server.summary()["dropped"] == 40


def test_changing_ones_mind_costs_no_room(serve, monkeypatch):
    monkeypatch.setattr(foxglove_visitor, "ROOM", 64)
    server = serve()
    with peer.Client(server.url, 2) as client:
        for turn in range(20):
            client.subscribe("/a")
            peer.wait(lambda: server.wanted(0))
            client.unsubscribe("/a")
            for first in range(10):
                server.publish(records([0] * 10, turn * 100 + first, 50))
            peer.wait(lambda: not server.wanted(0))
        client.drain()
        client.subscribe("/a")
        peer.wait(lambda: server.wanted(0))

        def all_had_room():
            before = server.summary()["dropped"]
            server.publish(records([0] * 64, 10_000, 50))
            client.drain()
            return server.summary()["dropped"] == before

        client.until(all_had_room)
        client.until(lambda: client.messages[-1].time_ns == 10_063)


class Ears:
    def __init__(self):
        self.heard = []

    def refusal(self, topic, type_name, encoding):
        return "" if topic == "/a" else f"{topic} is not for you"

    def publish(self, *message):
        self.heard.append(message)
        return self.refusal(*message[:3])


def test_clients_publish_where_they_may(serve):
    ears = Ears()
    server = serve(publisher=ears)
    with peer.Client(server.url, 2) as client:
        assert client.info["capabilities"] == ["time", "clientPublish"]
        assert client.info["supportedEncodings"] == ["cdr", "json"]
        client.advertise(1, "/a", STRING)
        client.advertise(2, "/b", STRING, "json")
        client.until(lambda: client.statuses)
        assert (client.statuses[0]["level"], client.statuses[0]["message"]) == (2, "/b is not for you")
        client.publish(1, b"12345")
        client.publish(2, b"{}")
        peer.wait(lambda: len(ears.heard) == 2)
        assert ears.heard == [("/a", STRING, "cdr", b"12345"), ("/b", STRING, "json", b"{}")]
        peer.wait(lambda: server.summary()["published"] + server.summary()["refused"] == 2)
        assert (server.summary()["published"], server.summary()["refused"]) == (1, 1)


def test_nobody_publishes_where_nobody_listens(serve):
    with peer.Client(serve().url, 2) as client:
        client.advertise(1, "/a", STRING)
        client.until(lambda: client.statuses)
        assert "clientPublish" in client.statuses[0]["message"]


class Deck:
    range_ns = (1_000_000_000, 5_000_000_000)
    state = PlaybackState("Paused", 1_000_000_000, 1.0)

    def __init__(self):
        self.asked = []

    def control(self, request):
        self.asked.append(request)
        return PlaybackState("Playing", request.seek_ns or 0, request.speed, seeked=True)


def test_clients_steer_playback_and_the_others_are_told(serve):
    deck = Deck()
    server = serve(player=deck)
    with peer.Client(server.url, 2) as client, peer.Client(server.url, 2) as other:
        assert client.info["capabilities"] == ["time", "playbackControl"]
        assert client.info["dataStartTime"] == {"sec": 1, "nsec": 0}
        assert client.info["dataEndTime"] == {"sec": 5, "nsec": 0}
        peer.wait(lambda: len(server.visitors) == 2)
        answer = client.control(play=True, speed=2.0, seek_ns=3_000_000_000, request="first")
        assert answer == ("playing", 3_000_000_000, 2.0, True, "first")
        assert deck.asked == [PlaybackRequest(playing=True, speed=2.0, seek_ns=3_000_000_000)]
        other.until(lambda: other.states)
        assert other.states == [("playing", 3_000_000_000, 2.0, True, "")]
        assert len(client.states) == 1


def test_strangers_are_sent_away(serve):
    server = serve()
    with socket.create_connection((server.endpoint.address, server.endpoint.port), peer.PATIENCE_S) as opened:
        opened.sendall(b"GET / HTTP/1.1\r\nHost: here\r\n\r\n")
        while opened.recv(4096):
            pass
    with socket.create_connection((server.endpoint.address, server.endpoint.port)):
        pass
    with peer.Client(server.url, 2):
        peer.wait(lambda: len(server.visitors) == 1)
        assert server.summary()["clients"][-1]["sent"] == 0
    peer.wait(lambda: not server.visitors)
    assert len(server.summary()["clients"]) == 1


def test_pages_of_strangers_are_kept_out(serve):
    told = []
    server = serve(guard=Guard(("https://viz.example.org",), told.append))
    for origin in ("https://evil.example", "null"):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            peer.Client(server.url, 2, origin=origin)
    assert [line.split()[4] for line in told] == ["https://evil.example", "null"]
    for origin in (None, "https://app.foxglove.dev", "http://localhost:8080", "https://viz.example.org"):
        with peer.Client(server.url, 2, origin=origin) as client:
            assert client.info["name"] == "test"
    peer.wait(lambda: not server.visitors)
    assert server.summary()["connections"] == 4


def test_who_is_just_leaving_ends_nothing(serve, monkeypatch):
    class Stopping:
        def __getattr__(self, name):
            def refuse(*_):
                raise RuntimeError("Already mutably borrowed")

            return refuse

    server = serve()
    with peer.Client(server.url, 2):
        peer.wait(lambda: server.visitors)
        (visitor,) = server.visitors
        with monkeypatch.context() as patch:
            patch.setattr(visitor, "_server", Stopping())
            server.tell_time(1)
            server.tell_state(PlaybackState("Playing", 1, 1.0))
            visitor._say("why", "/a")


def test_who_left_long_ago_is_added_up(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "_LISTED", 1)
    server = serve()
    for number in range(3):
        with peer.Client(server.url, 2) as client:
            client.subscribe("/a")
            peer.wait(lambda: server.wanted(0))
            server.publish(records([0], number, 8))
            client.until(lambda: client.messages)
        peer.wait(lambda: not server.visitors)
    told = server.summary()
    assert (told["connections"], len(told["clients"]), told["sent"]) == (3, 1, 3)


def test_the_end_is_said_to_all(serve):
    server = serve()
    with peer.Client(server.url, 2) as client:
        peer.wait(lambda: server.visitors)
        server.close()
        client.socket.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((server.endpoint.address, server.endpoint.port))
    server.close()


def test_a_port_in_use_is_one_line(serve):
    taken = serve().endpoint
    with pytest.raises(CaptureError, match=rf"127\.0\.0\.1:{taken.port}: cannot be listened on: .*in use"):
        FoxgloveServer(Offer("x", {}), [], taken)
    with pytest.raises(CaptureError, match=r"\.\.:1: cannot be listened on"):
        FoxgloveServer(Offer("x", {}), [], Endpoint("..", 1))


def test_without_the_sdk_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"pip install 'edoras-tools\[live\]'"):
        FoxgloveServer(Offer("x", {}), [], ANY)


def test_links_open_foxglove(serve):
    server = serve()
    assert server.url == f"ws://127.0.0.1:{server.endpoint.port}"
    assert server.app_url == f"https://app.foxglove.dev/?ds=foxglove-websocket&ds.url={server.url}"
