"""A recording of another tool in Foxglove: every topic with its schema, every message as it was."""

from __future__ import annotations

import base64
import threading
from contextlib import contextmanager

import foxglove_client as peer
import pytest
from others import IDL, TOPICS, read_bag, studio_message, write_bag, write_studio

from edoras_tools.model import Endpoint
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.live.player import PlaybackOptions, RecordingPlayer, open_recording
from edoras_tools.pipelines.live.run import attach_player
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings


@contextmanager
def played(path, places, **selection):
    """Yield a client of a recording that is played to its end; ``now`` moves with each look at the clock."""
    now = [0]

    def clock():
        now[0] += 50_000_000
        return now[0]

    info, bench, reopen = open_recording([path], Settings())
    scope = Scope(Selection(**selection))
    player = RecordingPlayer(reopen, bench, clock=clock, scope=scope, options=PlaybackOptions(paused=True))
    sink = attach_player(bench, info, player, listen=Endpoint("127.0.0.1", 0))
    thread = threading.Thread(target=player.run, args=(sink,))
    thread.start()
    try:
        with peer.Client(sink.server.url, places) as client:
            client.subscribe(*client.channels)
            peer.wait(lambda: all(sink.server.wanted(place) for place in range(places)))
            client.control(play=True)
            client.until(lambda: client.states and client.states[-1][0] == "ended")
            client.drain()
            yield client
    finally:
        player.stop()
        thread.join(peer.PATIENCE_S)
        assert not thread.is_alive()


def test_every_message_comes_as_it_was(tmp_path):
    bag = write_bag(tmp_path / "bag")
    with played(bag, len(TOPICS)) as client:
        found = {topic: [(item.time_ns, item.data) for item in client.on(topic)] for topic in TOPICS}
        kinds = {topic: channel["schemaName"] for topic, channel in client.channels.items()}
    said = read_bag(bag)
    assert kinds == TOPICS
    assert found == {
        topic: [(time_ns, data) for time_ns, name, _, data in said if name == topic] for topic in TOPICS
    }


def test_topics_have_their_own_schemas(tmp_path):
    with played(write_studio(tmp_path / "x.mcap"), 5) as client:
        channels = client.channels
        found = {topic: [item.data for item in client.on(topic)] for topic in channels}
    assert found == {topic: [studio_message(topic, number) for number in range(20)] for topic in channels}
    about = {topic: (item["encoding"], item["schemaEncoding"]) for topic, item in channels.items()}
    assert about == {
        "/status": ("json", "jsonschema"),
        "/proto": ("protobuf", "protobuf"),
        "/cmd_vel": ("cdr", "ros2msg"),
        "/outer": ("cdr", "ros2idl"),
        "/raw": ("cdr", ""),
    }
    assert base64.b64decode(channels["/proto"]["schema"]) == b"\x0a\x00"
    assert channels["/outer"]["schema"] == IDL


@pytest.mark.parametrize(
    ("selection", "count"), [({"topics": ["cmd_vel"]}, 100), ({"where": "linear.x > 9"}, 9)]
)
def test_what_is_chosen_is_played(selection, count, tmp_path):
    with played(write_bag(tmp_path / "bag"), len(TOPICS), **selection) as client:
        assert {topic: len(client.on(topic)) for topic in TOPICS if client.on(topic)} == {"/cmd_vel": count}
