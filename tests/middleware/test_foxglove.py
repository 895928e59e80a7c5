from __future__ import annotations

import json
import sys
from contextlib import suppress

import foxglove_client as peer
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.middleware import Qos
from edoras_tools.middleware.foxglove import as_cdr, full_type, open_graph
from edoras_tools.middleware.opening import open_graph as open_any
from edoras_tools.ros import TypeStore

QOS = Qos()
TWIST = "geometry_msgs/msg/Twist"
STORE = TypeStore()
CDR = STORE.encode(TWIST, {"linear": {"x": 0.5}})


@pytest.fixture
def graph():
    with_port = open_graph(STORE, "bridge", options={"port": "0"})
    yield with_port
    with_port.close()
    with_port.close()


def test_what_is_published_is_shown(graph):
    publish = graph.advertise("/cmd_vel", TWIST, QOS)
    assert [graph.notes(), graph.notes()] == [[f"Foxglove connects to {graph.url}"], []]
    with peer.Client(graph.url) as client:
        assert client.info["name"] == "bridge"
        told = client.channels["/cmd_vel"]
        assert (told["schemaName"], told["schema"]) == (TWIST, STORE.definition(TWIST))
        client.subscribe("/cmd_vel")

        def heard():
            publish(CDR)
            return client.messages

        client.until(heard)
        assert client.messages[0].data == CDR
    graph.close()
    publish(CDR)


@pytest.mark.parametrize(
    ("encoding", "name", "data"),
    [
        ("cdr", TWIST, CDR),
        ("json", TWIST, json.dumps({"linear": {"x": 0.5}}).encode()),
        ("json", "geometry_msgs/Twist", b'{"linear": {"x": 0.5}}'),
    ],
)
def test_what_clients_publish_is_heard(graph, encoding, name, data):
    heard = []
    graph.subscribe("/cmd_vel", TWIST, QOS, heard.append)
    graph.advertise("/cmd_vel", TWIST, QOS)(CDR)
    assert not heard, "a node never hears itself"
    with peer.Client(graph.url) as client:
        client.advertise(1, "/cmd_vel", name, encoding)
        client.publish(1, data)
        peer.wait(lambda: heard)
        assert heard == [CDR]
        client.say(op="unadvertise", channelIds=[1])
        client.publish(1, data)
        client.until(lambda: client.statuses)
    assert heard == [CDR]


@pytest.mark.parametrize(
    ("topic", "name", "encoding", "data", "why"),
    [
        ("/other", TWIST, "cdr", CDR, "/other: nobody listens; topics: /cmd_vel"),
        ("/cmd_vel", "std_msgs/msg/String", "cdr", CDR, "takes geometry_msgs/msg/Twist, not std_msgs"),
        ("/cmd_vel", TWIST, "protobuf", CDR, "publish cdr or json"),
        ("/cmd_vel", TWIST, "cdr", CDR[:20], "/cmd_vel: "),
        ("/cmd_vel", TWIST, "json", b"[", "is no JSON"),
    ],
)
def test_what_does_not_fit_is_told_and_not_heard(graph, topic, name, encoding, data, why):
    heard = []
    graph.subscribe("/cmd_vel", TWIST, QOS, heard.append)
    graph.advertise("/shown", TWIST, QOS)
    with peer.Client(graph.url) as client:
        client.advertise(1, topic, name, encoding)
        client.publish(1, data)
        client.until(lambda: any(why in item["message"] for item in client.statuses))
        peer.wait(lambda: graph.refused == 1)
    assert not heard


def test_types_must_be_known_and_one_a_topic(graph):
    with pytest.raises(ConfigError, match="geometry_msgs/msg/Twisst"):
        graph.advertise("/a", "geometry_msgs/msg/Twisst", QOS)
    graph.subscribe("/a", TWIST, QOS, lambda _: None)
    with pytest.raises(ConfigError, match="/a is geometry_msgs/msg/Twist in this graph"):
        graph.advertise("/a", "std_msgs/msg/String", QOS)


def test_options_and_addresses_that_cannot_be_are_one_line(graph):
    port = graph.url.rpartition(":")[2]
    with pytest.raises(
        ConfigError, match=rf"--ros-option port: 127\.0\.0\.1:{port}: cannot be listened on: .*in use"
    ):
        open_graph(STORE, "other", options={"port": port})
    with pytest.raises(ConfigError, match="no option 'prot'; there are host, port"):
        open_graph(STORE, "other", options={"prot": "1"})
    for port in ("70000", "x", ""):
        with pytest.raises(ConfigError, match="is no TCP port"):
            open_graph(STORE, "other", options={"port": port})


def test_pages_of_strangers_are_kept_out_and_told(graph):
    assert graph.notes() == [f"Foxglove connects to {graph.url}"]
    with pytest.raises(InvalidStatus, match="HTTP 403"):
        peer.Client(graph.url, origin="https://evil.example")
    (note,) = graph.notes()
    assert "https://evil.example was kept out" in note
    graph.advertise("/shown", TWIST, QOS)
    for origin in (None, "https://app.foxglove.dev"):
        with peer.Client(graph.url, origin=origin):
            pass
    other = open_graph(STORE, "other", options={"port": "0", "origins": "https://evil.example,http://b.lab"})
    other.advertise("/shown", TWIST, QOS)
    with peer.Client(other.url, origin="https://evil.example"):
        pass
    other.close()


def test_without_the_sdk_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"pip install 'edoras-tools\[live\]'"):
        open_any("foxglove", STORE, "bridge")


def test_nobody_hears_anything_after_the_end(graph):
    heard = []
    graph.subscribe("/cmd_vel", TWIST, QOS, heard.append)
    graph.advertise("/shown", TWIST, QOS)
    with peer.Client(graph.url) as client:
        client.advertise(1, "/cmd_vel", TWIST)
        client.publish(1, CDR)
        peer.wait(lambda: heard)
        graph.close()
    assert heard == [CDR]


@given(st.sampled_from(["cdr", "json"]), st.binary(max_size=100))
def test_anything_may_be_published(encoding, data):
    with suppress(EdorasError):
        STORE.decode(TWIST, as_cdr(STORE, TWIST, encoding, data))


@given(st.text(max_size=20))
def test_any_name_is_a_name(name):
    assert "/msg/" in full_type(name)
