from __future__ import annotations

import sys

import foxglove_client as peer
import pytest
from websockets.exceptions import InvalidStatus

from edoras_tools.addons.foxglove.graph import open_graph
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.middleware.graph import open_graph as open_any
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
    assert [graph.notes(), graph.notes()] == [[f"Foxglove connects to {graph.server.url}"], []]
    with peer.Client(graph.server.url) as client:
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


def test_what_clients_publish_is_heard_if_it_fits(graph):
    heard = []
    graph.subscribe("/cmd_vel", TWIST, QOS, heard.append)
    graph.advertise("/cmd_vel", TWIST, QOS)(CDR)
    assert not heard, "a node never hears itself"
    with peer.Client(graph.server.url) as client:
        client.advertise(1, "/cmd_vel", TWIST, "json")
        client.advertise(2, "/other", TWIST)
        client.publish(2, b"")
        client.publish(1, b'{"linear": {"x": 0.5}}')
        client.publish(1, b"[")
        client.until(lambda: len(client.statuses) == 2)
    assert heard == [CDR]
    why, also = (item["message"] for item in client.statuses)
    assert why == "/other: nobody listens; topics: /cmd_vel"
    assert also.startswith("/cmd_vel: is not JSON")


def test_types_must_be_known_and_one_a_topic(graph):
    with pytest.raises(ConfigError, match="geometry_msgs/msg/Twisst"):
        graph.advertise("/a", "geometry_msgs/msg/Twisst", QOS)
    graph.subscribe("/a", TWIST, QOS, lambda _: None)
    with pytest.raises(ConfigError, match="/a is geometry_msgs/msg/Twist in this graph"):
        graph.advertise("/a", "std_msgs/msg/String", QOS)


def test_options_and_addresses_that_cannot_be_are_one_line(graph):
    port = graph.server.url.rpartition(":")[2]
    with pytest.raises(
        ConfigError, match=rf"--ros-option port: 127\.0\.0\.1:{port}: cannot listen: .*in use"
    ):
        open_graph(STORE, "other", options={"port": port})
    with pytest.raises(ConfigError, match="no option 'prot'; there are host, port"):
        open_graph(STORE, "other", options={"prot": "1"})
    for port in ("70000", "x", ""):
        with pytest.raises(ConfigError, match="is not a TCP port"):
            open_graph(STORE, "other", options={"port": port})


def test_pages_of_strangers_are_kept_out_and_told(graph):
    assert graph.notes() == [f"Foxglove connects to {graph.server.url}"]
    with pytest.raises(InvalidStatus, match="HTTP 403"):
        peer.Client(graph.server.url, origin="https://evil.example")
    (note,) = graph.notes()
    assert "https://evil.example was refused as a client" in note
    graph.advertise("/shown", TWIST, QOS)
    for origin in (None, "https://app.foxglove.dev"):
        with peer.Client(graph.server.url, origin=origin):
            pass
    other = open_graph(STORE, "other", options={"port": "0", "origins": "https://evil.example,http://b.lab"})
    other.advertise("/shown", TWIST, QOS)
    with peer.Client(other.server.url, origin="https://evil.example"):
        pass
    other.close()


def test_without_websockets_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ConfigError, match=r"pip install 'edoras-tools\[live\]'"):
        open_any("foxglove", STORE, "bridge")


def test_nobody_hears_anything_after_the_end(graph):
    heard = []
    graph.subscribe("/cmd_vel", TWIST, QOS, heard.append)
    graph.advertise("/shown", TWIST, QOS)
    with peer.Client(graph.server.url) as client:
        client.advertise(1, "/cmd_vel", TWIST)
        client.publish(1, CDR)
        peer.wait(lambda: heard)
        graph.close()
    assert heard == [CDR]
