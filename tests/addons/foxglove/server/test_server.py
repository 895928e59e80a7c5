from __future__ import annotations

import re
import socket
import sys
from contextlib import ExitStack, suppress
from functools import partial
from threading import Event

import foxglove_client as peer
import numpy as np
import pytest
import waiting
from waiting import PATIENCE_S
from websockets.exceptions import InvalidStatus

from edoras_tools.addons.foxglove.server import client as foxglove_client
from edoras_tools.addons.foxglove.server import server as foxglove_server
from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.addons.foxglove.server.protocol import PlaybackRequest, PlaybackState, Publisher
from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.topics.messages import Records
from edoras_tools.io.topics.streams import Topic
from edoras_tools.model import Endpoint

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

    def start(**options):
        servers.append(FoxgloveServer("test", TOPICS, types.definition, ServerOptions(ANY, **options)))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_topics_and_their_schemas_are_told(serve, types, subprotocol):
    with peer.Client(serve().url, 2, subprotocols=["else", subprotocol]) as client:
        assert client.socket.subprotocol == subprotocol
        assert client.info["name"] == "test"
        assert client.info["capabilities"] == ["time"]
        assert client.info["sessionId"]
        told = client.channels["/a"]
        assert (told["encoding"], told["schemaName"], told["schemaEncoding"]) == ("cdr", STRING, "ros2msg")
        assert told["schema"] == types.definition(STRING)
        assert told["metadata"] == {"link": "ci"}


def test_a_client_gets_what_it_subscribed_to_and_nothing_else(serve):
    server = serve()
    with peer.Client(server.url, 2) as client, peer.Client(server.url, 2) as other:
        client.subscribe("/b")
        other.subscribe("/a", "/b")
        waiting.until(lambda: server.has_subscribers(0) and all(item.wants(1) for item in server.clients))
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
        waiting.until(lambda: server.has_subscribers(2))
        server.publish(records([2], 1, 30))
        client.until(lambda: client.on("/late"))
    with peer.Client(server.url, 3) as client:
        assert "/late" in client.channels


def test_a_client_that_does_not_read_holds_up_nobody_and_its_losses_are_counted(serve):
    server = serve()
    total, size, piece = 24_000, 260, 2000
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    narrow.connect((server.endpoint.address, server.endpoint.port))
    with peer.Client(server.url, 2) as quick, peer.Client(server.url, 2, sock=narrow, max_queue=1) as slow:
        quick.subscribe("/a")
        slow.subscribe("/a")
        waiting.until(lambda: len(server.clients) == 2 and all(item.wants(0) for item in server.clients))
        for first in range(0, total, piece):
            server.publish(records([0] * piece, first, size))
            while len(quick.messages) < first + piece:
                assert quick.take()
        assert [item.time_ns for item in quick.messages] == list(range(total))

        def row(client):
            address = str(Endpoint(*client.socket.socket.getsockname()[:2]))
            return next(item for item in server.summary()["clients"] if item["address"] == address)

        waiting.until(lambda: row(quick)["sent"] == total)  # counted once it is on its way
        assert row(quick)["dropped"] == 0
        dropped = row(slow)["dropped"]
        assert dropped > total // 2
        assert 0 <= total - dropped - row(slow)["sent"] <= foxglove_client.MOST_MESSAGES
        # Once it reads, it gets what waited, and every message is accounted for.
        slow.until(lambda: len(slow.messages) == total - dropped)
        server.publish(records([0], total, size))
        slow.until(lambda: slow.messages[-1].time_ns == total)
        waiting.until(lambda: row(slow)["sent"] == len(slow.messages) == total + 1 - dropped)
        assert row(slow)["dropped"] == dropped


def test_no_more_bytes_wait_than_there_is_room_for(serve, monkeypatch):
    monkeypatch.setattr(foxglove_client, "MOST_WAITING_BYTES", 100_000)
    server = serve()
    with peer.Client(server.url, 2) as client:
        client.subscribe("/a")
        waiting.until(lambda: server.has_subscribers(0))
        server.publish(records([0] * 50, 0, 10_000))
        client.until(lambda: len(client.messages) == 10)
        assert [item.time_ns for item in client.messages] == list(range(40, 50))
        waiting.until(lambda: server.summary()["sent"] == 10)
        # One message may always wait, however large it is.
        server.publish(records([0], 50, 300_000))
        client.until(lambda: client.messages[-1].time_ns == 50)
        assert server.summary()["dropped"] == 40


def test_clients_publish_where_they_may(serve, types):
    heard = []
    publisher = Publisher(types, "{} is not for you".format)
    publisher.accept("/a", STRING, lambda cdr: heard.append(cdr) or "")
    server = serve(publisher=publisher)
    cdr = types.encode(STRING, {"data": "hello"})
    with peer.Client(server.url, 2) as client:
        assert client.info["capabilities"] == ["time", "clientPublish"]
        assert client.info["supportedEncodings"] == ["cdr", "json"]
        client.advertise(1, "/a", STRING)
        client.advertise(2, "/b", STRING, "json")
        client.publish(1, cdr)
        client.publish(2, b"{}")
        client.publish(2, b"{}")
        waiting.until(lambda: server.summary()["refused"] == 2)
        client.until(lambda: client.statuses)
        told = {"op": "status", "level": 2, "message": "/b is not for you", "id": "/b"}
        assert client.statuses == [told], "at the first message, and not again"
        assert heard == [cdr]
        assert server.summary()["published"] == 1
        client.say(op="unadvertise", channelIds=[1])
        client.publish(1, cdr)
        client.until(lambda: client.statuses[-1]["message"] == "channel 1 was not advertised")
    assert heard == [cdr]


def test_what_is_not_served_is_told(serve):
    with peer.Client(serve().url, 2) as client:
        client.advertise(1, "/a", STRING)
        client.publish(1, b"")
        client.until(lambda: client.statuses)
        assert "clientPublish" in client.statuses[0]["message"]
        client.say(op="getParameters", parameterNames=[])
        client.until(lambda: len(client.statuses) == 2)
        assert "getParameters" in client.statuses[1]["message"]


def test_who_asks_and_never_reads_is_disconnected_and_the_terminal_is_told(serve):
    told = []
    server = serve(origins=OriginCheck((), told.append))
    with socket.create_connection((server.endpoint.address, server.endpoint.port), PATIENCE_S) as opened:
        opened.sendall(UPGRADE + b"\r\n")
        waiting.until(lambda: server.clients)
        nonsense = b'{"op": "' + b"x" * 100 + b'"}'
        frame = bytes((0x81, 0x80 | len(nonsense))) + bytes(4) + nonsense  # masked with zeros
        with suppress(ConnectionError):
            for _ in range(500):
                opened.sendall(frame * 100)
        waiting.until(lambda: not server.clients)
    assert told == ["a client at 127.0.0.1 was disconnected: it does not read its answers"]


class Deck:
    range_ns = (1_000_000_000, 5_000_000_000)
    state = PlaybackState("Paused", 1_000_000_000, 1.0)
    waiting = False

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
        waiting.until(lambda: len(server.clients) == 2)
        answer = client.control(play=True, speed=2.0, seek_ns=3_000_000_000, request="first")
        assert answer == ("playing", 3_000_000_000, 2.0, True, "first")
        assert deck.asked == [PlaybackRequest(playing=True, speed=2.0, seek_ns=3_000_000_000)]
        other.until(lambda: len(other.states) == 2)
        at_first = ("paused", 1_000_000_000, 1.0, False, "")
        assert other.states == [at_first, ("playing", 3_000_000_000, 2.0, True, "")]
        assert client.states == [at_first, answer]


def test_a_client_gets_its_own_first_subprotocol_and_playback_only_where_that_has_it(serve):
    """Lichtblick offers the older one first, and takes the state of playback for an error."""
    server = serve(player=Deck())
    both = ["foxglove.websocket.v1", "foxglove.sdk.v1"]
    with peer.Client(server.url, 2, subprotocols=both) as client, peer.Client(server.url, 2) as other:
        assert client.socket.subprotocol == both[0]
        assert client.info["capabilities"] == ["time"]
        other.control(play=True)
        server.tell_state(Deck.state)
        server.tell_time(7)
        client.until(lambda: len(client.times) == 2)
        assert client.states == []


def answer(server, *pieces):
    """What the server answers to bytes that are sent piece by piece, until it hangs up."""
    with socket.create_connection((server.endpoint.address, server.endpoint.port), PATIENCE_S) as opened:
        for piece in pieces:
            opened.sendall(piece)
        received = b""
        with suppress(ConnectionError):  # bytes that were never read are answered with a reset
            while more := opened.recv(4096):
                received += more
    return received


UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: here\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n"
)


def test_what_is_no_foxglove_client_is_told_so(serve, capfd):
    told = []
    server = serve(origins=OriginCheck((), told.append))
    assert answer(server, b"GET / HT", b"TP/1.1\r\nHost: [::1]\r\n\r\n").startswith(b"HTTP/1.1 200 ")
    other = UPGRADE.replace(b"foxglove.sdk.v1", b"chat")
    offers = "it offers chat, not foxglove.sdk.v1 or foxglove.websocket.v1"
    assert offers.encode() in answer(server, other + b"\r\n")
    assert told[-1] == f"a client at 127.0.0.1 was refused: {offers}"
    assert answer(server, b"\x16\x03\x01 this is TLS\r\n\r\n") == b""
    assert told[-1] == "a client at 127.0.0.1 was refused: it speaks TLS; use http:// or ws://"
    too_long = answer(server, b"GET /" + b"x" * 100_000)
    # websockets before 17, the last for Python 3.10, closes without an answer
    assert too_long.startswith(b"HTTP/1.1 414 ") or (sys.version_info < (3, 11) and too_long == b"")
    with socket.create_connection((server.endpoint.address, server.endpoint.port)):
        pass
    assert server.summary()["connections"] == 0
    assert all(line.startswith("a client at 127.0.0.1 was refused: ") for line in told)
    assert len(told) == len({*told}) >= 3
    assert capfd.readouterr() == ("", "")


def test_who_never_asks_is_disconnected(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "PATIENCE_S", 0.05)
    assert answer(serve(), b"GET /") == b""


def test_connections_that_never_ask_shut_nobody_out(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "PATIENCE_S", 10 * PATIENCE_S)
    server = serve()
    place = (server.endpoint.address, server.endpoint.port)
    with ExitStack() as opened:
        idle = [
            opened.enter_context(socket.create_connection(place, PATIENCE_S))
            for _ in range(foxglove_server.MOST_CLIENTS + 1)
        ]
        assert opened.enter_context(peer.Client(server.url, 2)).channels
        assert idle[0].recv(1) == b"", "the oldest made room"


def test_a_flood_of_connections_that_never_ask_shuts_nobody_out(serve, monkeypatch):
    """The kernel keeps them while the server is busy: one that it dropped would ask again after seconds."""
    busy, accept = Event(), FoxgloveServer._accept_all
    monkeypatch.setattr(FoxgloveServer, "_accept_all", lambda self: (busy.wait(), accept(self)))
    server = serve()
    place = (server.endpoint.address, server.endpoint.port)
    with ExitStack() as opened:
        monkeypatch.setattr(socket, "create_connection", partial(socket.create_connection, timeout=0.9))
        for _ in range(600):  # more than the 128 that Python asks the kernel to keep
            opened.enter_context(socket.create_connection(place))
        asking = opened.enter_context(socket.create_connection(place))
        asking.sendall(UPGRADE + b"\r\n")
        for _ in range(300):
            opened.enter_context(socket.create_connection(place))
        asking.settimeout(PATIENCE_S)
        busy.set()
        assert asking.recv(12) == b"HTTP/1.1 101"


def test_the_address_with_most_connections_makes_room(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "PATIENCE_S", 10 * PATIENCE_S)
    server = serve()
    place = (server.endpoint.address, server.endpoint.port)
    with ExitStack() as opened:
        slow = opened.enter_context(socket.create_connection(place, PATIENCE_S, ("127.0.0.2", 0)))
        many = [
            opened.enter_context(socket.create_connection(place, PATIENCE_S))
            for _ in range(2 * foxglove_server.MOST_CLIENTS)
        ]
        assert many[0].recv(1) == b"", "of the many the oldest made room"
        slow.sendall(UPGRADE + b"\r\n")
        assert slow.recv(12) == b"HTTP/1.1 101", "and not the slow one"


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("", 401),
        ("?token=", 401),
        ("?token=wrong", 401),
        ("?token=s%C3%A9same%20", 401),
        ("?token=s%C3%A9same&token=no", 401),
        ("?TOKEN=s%C3%A9same", 401),
        ("?token=s%C3%A9same", 101),
        ("x?a=b&token=s%C3%A9same", 101),
        ("?token=%ff", 401),
        ("/[?token=s%C3%A9same", 101),
    ],
)
def test_who_has_no_token_is_turned_away(serve, query, status):
    told = []
    server = serve(token="sésame", origins=OriginCheck((), told.append))
    place = (server.endpoint.address, server.endpoint.port)
    with socket.create_connection(place, PATIENCE_S) as opened:
        opened.sendall(UPGRADE.replace(b"GET /", b"GET /" + query.encode()) + b"\r\n")
        answered = opened.recv(4096)
    assert answered.startswith(f"HTTP/1.1 {status} ".encode())
    assert all(re.search(r"its token is (wrong|missing); give \?token=", line) for line in told)
    assert bool(told) is (status == 401)
    assert "sésame" not in server.app_url + server.url + repr(server._options)


def test_a_client_with_the_token_is_served(serve):
    with peer.Client(f"{serve(token='a/b').url}/?token=a%2Fb", 2) as client:
        assert client.channels


def test_no_more_clients_than_there_may_be(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "MOST_CLIENTS", 1)
    told = []
    server = serve(origins=OriginCheck((), told.append))
    with peer.Client(server.url, 2):
        assert b"1 clients are connected" in answer(server, UPGRADE + b"\r\n")
    assert told == ["a client at 127.0.0.1 was refused: 1 clients are connected, which is the maximum"]
    waiting.until(lambda: not server.clients)
    with peer.Client(server.url, 2):
        pass


def test_web_pages_are_asked_for_their_origin(serve):
    told = []
    server = serve(origins=OriginCheck(("https://viz.example.org",), told.append))
    for _ in range(2):
        for origin in ("https://evil.example", "null"):
            with pytest.raises(InvalidStatus, match="HTTP 403"):
                peer.Client(server.url, 2, origin=origin)
    assert [line.split()[4] for line in told] == ["https://evil.example", "null"]
    assert told[0].endswith("; --allow-origin https://evil.example allows it")
    two = b"Origin: https://app.foxglove.dev\r\nOrigin: https://evil.example\r\n\r\n"
    assert answer(server, UPGRADE + two).startswith(b"HTTP/1.1 400 ")
    for origin in (None, "https://app.foxglove.dev", "http://localhost:8080", "https://viz.example.org"):
        with peer.Client(server.url, 2, origin=origin) as client:
            assert client.info["name"] == "test"
    waiting.until(lambda: not server.clients)
    assert server.summary()["connections"] == 4


def test_a_terminal_is_told_nothing_but_text_and_not_for_ever(serve):
    told = []
    server = serve(origins=OriginCheck((), told.append))
    answer(server, UPGRADE + b"Origin: http://\xff" + b"x" * 5000 + b"\r\n\r\n")
    assert told[0].startswith("a web page of http://?xxx")
    assert len(told[0]) < 300
    for number in range(20):
        answer(server, UPGRADE + b"Origin: https://%d.example\r\n\r\n" % number)
    assert len(told) == foxglove_server._MOST_TOLD


def test_a_topic_that_comes_later_loses_nothing_once_it_is_subscribed_to(serve):
    """A client that subscribes at once gets every message from then on, whoever publishes meanwhile."""
    server = serve()
    with peer.Client(server.url, 2) as client:
        place = server.add(Topic("/late", STRING))
        client.until(lambda: "/late" in client.channels)
        client.subscribe("/late")
        numbers = iter(range(100_000))

        def goes_on():
            server.publish(records([place], next(numbers), 8))
            return client.messages

        client.until(goes_on)
        last = next(numbers)
        server.publish(records([place], last, 8))
        client.until(lambda: client.messages[-1].time_ns == last)
        times = [item.time_ns for item in client.messages]
        assert times == list(range(times[0], last + 1))


def test_who_left_long_ago_is_added_up(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "_MOST_LISTED", 1)
    server = serve()
    for number in range(3):
        with peer.Client(server.url, 2) as client:
            client.subscribe("/a")
            waiting.until(lambda: server.has_subscribers(0))
            server.publish(records([0], number, 8))
            client.until(lambda: client.messages)
        waiting.until(lambda: not server.clients)
    told = server.summary()
    assert (told["connections"], len(told["clients"]), told["sent"]) == (3, 1, 3)


def test_the_end_is_said_to_all(serve):
    server = serve()
    with peer.Client(server.url, 2) as client:
        waiting.until(lambda: server.clients)
        server.close()
        client.socket.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((server.endpoint.address, server.endpoint.port))
    server.close()


def test_a_port_in_use_is_one_line(serve):
    taken = serve().endpoint
    with pytest.raises(CaptureError, match=rf"127\.0\.0\.1:{taken.port}: cannot listen: .*in use"):
        FoxgloveServer("x", [], str, ServerOptions(taken))
    with pytest.raises(CaptureError, match=r"\.\.:1: cannot listen"):
        FoxgloveServer("x", [], str, ServerOptions(Endpoint("..", 1)))


def test_without_websockets_it_is_said_what_to_install(serve, monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ConfigError, match=r"pip install 'edoras-tools\[live\]'"):
        serve()


def test_links_open_foxglove(serve):
    server = serve()
    assert server.url == f"ws://127.0.0.1:{server.endpoint.port}"
    assert server.app_url == f"https://app.foxglove.dev/?ds=foxglove-websocket&ds.url={server.url}"
