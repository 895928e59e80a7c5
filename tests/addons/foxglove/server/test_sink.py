from __future__ import annotations

import base64
import json
import re
import threading
from contextlib import contextmanager
from functools import cache

import foxglove_client as peer
import merging
import numpy as np
import pytest
import waiting
from mcap.reader import make_reader
from others import IDL, TOPICS, read_bag, studio_message, write_bag, write_studio
from places import ROOT
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edoras_tools.addons.foxglove.player import (
    PlaybackOptions,
    RecordingPlayer,
    attach,
    attach_player,
    open_recording,
)
from edoras_tools.addons.foxglove.server import link_state
from edoras_tools.addons.foxglove.server.server import ServerOptions
from edoras_tools.addons.foxglove.server.sink import FoxgloveSink, LinkMonitor
from edoras_tools.decode import Context
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io import RecordingOptions
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.topics.messages import Records
from edoras_tools.links.bare import CI
from edoras_tools.model import Endpoint, Finding, SourceStatistics
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.reading import reading, selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.faults.rules import Fault

ANY = ServerOptions(Endpoint("127.0.0.1", 0))
LAST = 1
OWN = 5
"""Topics beside those of the mission."""


@pytest.fixture
def serve(types):
    sinks = []

    def start(read, **options):
        sinks.append(FoxgloveSink(Context(read.mission, types), types, read.info, ANY, **options))
        return sinks[-1]

    yield start
    for sink in sinks:
        sink.close(SourceStatistics())


def show(sink, read, meanwhile=lambda: None):
    """A client that has subscribed to everything, after all was written; and what it was told.

    All is written twice: some topics are there only once there is a message for them.
    """
    for batch, columns in read.pairs:
        sink.write(batch, columns)
    sink.restart()
    meanwhile()
    topics = len(sink.server._channels)
    with peer.Client(sink.server.url, topics) as client:
        client.subscribe()
        peer.wait(lambda: all(sink.server.has_subscribers(place) for place in range(topics)))
        for batch, columns in read.pairs:
            sink.write(batch, columns)
        # Messages come in order: once this one is there, all are.
        none, place = np.zeros(1, np.int64), np.full(1, topics - 1, np.uint16)
        sink.server.publish(Records(place, np.full(1, LAST, np.uint64), none, none, b""))
        client.until(lambda: client.messages and client.messages[-1].time_ns == LAST)
        client.messages.pop()
        assert sink.summary()["dropped"] == 0
    return client


def recorded(path, read, types):
    """What a recording of the same holds: (topic, time) to data."""
    sink = McapSink(path, read.mission, types, read.info, RecordingOptions(transforms=True))
    for batch, columns in read.pairs:
        sink.write(batch, columns)
    sink.close(SourceStatistics())
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


@cache
def judge(schema, name):
    """rosbags, which knows a type only from the schema that the server told."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema, name))
    return store


def decoded(client, message):
    told = client.channels[message.topic]
    return judge(told["schema"], told["schemaName"]).deserialize_cdr(message.data, told["schemaName"])


def test_what_is_served_is_what_a_recording_holds(serve, capture, types, tmp_path):
    rover = capture("a_rover", "rover_ground")
    client = show(serve(rover), rover)
    expected = recorded(tmp_path / "a.mcap", rover, types)
    # The last second of the statistics ends with the recording; a server has no such end.
    ending = max(time for topic, time, _ in expected if topic == "/edoras/link_statistics")
    expected = [item for item in expected if item[:2] != ("/edoras/link_statistics", ending)]
    assert [item for item in client.messages if item.topic != "/diagnostics"] == expected
    assert len(client.on("/cmd_vel")) == 600


def test_a_source_gathers_for_longer_where_no_client_has_subscribed(serve, capture):
    rover, paces = capture("a_rover", "rover_ground"), []
    sink = serve(rover)
    sink.pace = paces.append
    sink.write(*rover.pairs[0])
    with peer.Client(sink.server.url, len(sink.server._channels)) as client:
        sink.write(*rover.pairs[0])
        client.subscribe("/cmd_vel")
        peer.wait(lambda: sink.server.subscriptions)
        sink.write(*rover.pairs[0])
        assert paces == [0.95, 0.95, 0.2]


def test_what_is_watched_without_a_server_has_the_doctors_figures_at_its_routes(capture, types):
    rover = capture("a_rover", "rover_ground")
    watched = LinkMonitor(Context(rover.mission, types), types, "a", {}, None, live=False)
    for batch, columns in rover.pairs:
        watched.add(batch, columns)
    watched.finish()
    whole = sum(map(len, rover.batches))
    waiting.until(lambda: (watched.state()["doctor"] or {}).get("lost"))
    state = watched.state()
    watched.close()
    rows = {item["topic"] or item["name"]: item for item in state["routes"]}
    assert state["silent_s"] == 0, "of a file"
    assert sum(item["count"] for item in state["routes"]) == whole, "the last second too"
    row = rows["/cmd_vel"]
    assert (row["count"], row["lost"], row["uncertain"]) == (600, 92, 0)
    assert (row["rate_hz"], row["sent_hz"]) == (7.0, None)
    assert row["passed_hz"] == pytest.approx(7 * 508 / 600)
    assert rows["ES_HK"]["passed_hz"] is None
    seen = {(item["link"], bool(item["seen_going_in"])) for item in state["doctor"]["routes"]}
    assert seen == {("ci", True), ("to", False)}, "or a rate that comes would be taken for one that is sent"
    assert sum(item["lost"] for item in state["routes"]) == state["doctor"]["lost"]


@pytest.mark.long
def test_rosbags_reads_every_message_by_the_schema_that_was_told(serve, capture):
    rover = capture("a_rover", "rover_ground")
    client = show(serve(rover), rover)
    assert {channel["encoding"] for channel in client.channels.values()} == {"cdr"}
    twist = decoded(client, client.on("/cmd_vel")[2])
    assert (twist.linear.x, twist.angular.z) == (0.5099833416646828, 0.19900083305560518)
    pose = decoded(client, client.on("/telemetry_pose")[2])
    assert (pose.header.frame_id, pose.pose.position.y, pose.pose.orientation.w) == ("world", 0.5, 1.0)
    assert client.channels["/telemetry_pose"]["metadata"]["msg_id"] == "0x0827"
    event = next(
        item for item in (decoded(client, raw) for raw in client.on("/edoras/events")) if item.level == 40
    )
    assert event.msg == "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"
    counts = [decoded(client, item) for item in client.on("/edoras/link_statistics")]
    assert sum(item.count for item in counts if item.topic == "/cmd_vel") > 550
    assert client.times[-1] == rover.batches[-1].time_ns[-1]


def test_findings_become_diagnostics(serve, capture):
    errors = capture("e_ci_errors", "rover_ground")
    levels = {Finding.TRUNCATED: 2, Finding.LENGTH_MISMATCH: 1, Finding.SEQUENCE_UNSET: 0}
    levels |= {item: 0 for item in Finding if item not in levels}
    statistics = SourceStatistics(kernel_drops=0)
    sink = serve(errors, levels=levels, statistics=statistics)
    client = show(sink, errors, lambda: setattr(statistics, "kernel_drops", 7))
    arrays = [decoded(client, item) for item in client.on("/diagnostics")]
    assert arrays
    statuses = {status.name: status for array in arrays for status in array.status}
    assert (statuses["capture"].level, statuses["capture"].message) == (
        2,
        "7 packets lost by the capture itself",
    )
    truncated = [item for item in statuses.values() if item.message == "truncated"]
    assert truncated
    assert {item.level for item in truncated} == {2}
    assert all(item.level == 0 for item in statuses.values() if item.message == "OK")
    values = {value.key: value.value for value in truncated[0].values}
    assert int(values["truncated"]) >= 1
    assert int(values["datagrams"]) >= int(values["truncated"])


def test_what_was_done_on_purpose_is_told(serve, capture):
    rover = capture("a_rover", "rover_ground")
    sink = serve(rover)
    fault = Fault(5_000_000_000, "drop", "", b"", CI, to_cfs=True, msg_id=0x1827, rule="drop:1")
    sink.write_faults([fault])
    with peer.Client(sink.server.url, OWN + 3) as client:
        client.subscribe("/edoras/faults")
        peer.wait(lambda: sink.server.has_subscribers(OWN + 2))
        sink.write_faults([fault])
        client.until(lambda: client.messages)
        told = decoded(client, client.messages[0])
        assert (told.kind, told.msg_id, told.rule) == ("drop", 0x1827, "drop:1")


def test_the_layout_that_is_shipped_finds_its_topics(serve, capture):
    """Topics of the layout's panels are there, with the fields that they plot."""
    rovers = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    sink = serve(rovers)
    layout = json.loads((ROOT / "samples/foxglove_layout.json").read_text())
    panels = layout["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    named = {re.match(r"/[\w/]+", path).group() for path in paths}
    named |= {topic for panel in panels.values() for topic in panel.get("topics", ())}
    named |= {panel["topicToRender"] for panel in panels.values() if "topicToRender" in panel}
    with peer.Client(sink.server.url, OWN + len(rovers.mission.routes)) as client:
        assert named <= {*client.channels}
        for path in paths:
            topic, fields = re.fullmatch(r"(/[\w/]+)(?:\{.*\})?\.([\w.]+)", path).groups()
            channel = client.channels[topic]
            store = judge(channel["schema"], channel["schemaName"])
            kind = channel["schemaName"]
            for field in fields.split("."):
                _, members = store.fielddefs[kind]
                found = dict(members)[field]
                kind = found[1]


def test_a_batch_of_none_is_a_batch(serve, capture):
    rover = capture("a_rover", "rover_ground")
    sink = serve(rover)
    sink.write(rover.batches[0].take(slice(0, 0)), rover.columns[0].take(slice(0, 0)))
    sink.flush()


def test_samples_of_dds_are_offered_and_sent():
    source = open_files([ROOT / "samples/rtps/cyclone_sender.pcap.gz"])
    bench = Settings().workbench(source.info)
    read = [(rows.batch, rows.columns) for rows in selected_rows(source, bench, selection=Selection())]
    sink = attach(bench, source.info, listen=ANY.listen)
    try:
        own = {item["topic"]: item for item in sink.server._channels}  # before the first sample
        assert own["/cmd_vel"]["schemaName"] == "geometry_msgs/msg/Twist"
        with peer.Client(sink.server.url, len(sink.server._channels)) as client:
            client.subscribe("/cmd_vel")
            peer.wait(lambda: sink.server.has_subscribers(own["/cmd_vel"]["id"]))
            for batch, columns in read:
                sink.write(batch, columns)
            client.until(lambda: len(client.messages) == 100)
        values = [bench.types.decode("geometry_msgs/msg/Twist", item.data) for item in client.messages]
        assert sorted(item["linear"]["x"] for item in values) == [number / 10 for number in range(100)]
    finally:
        sink.close(SourceStatistics())


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
            peer.wait(lambda: all(sink.server.has_subscribers(place) for place in range(places)))
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


@pytest.fixture(scope="module")
def rovers(tmp_path_factory):
    """Two rovers in one capture, and each by itself; both lose commands of one MsgId."""
    names = {"10.0.0.2": "a_rover", "10.0.0.3": "e_ci_errors"}
    files = {address: ROOT / f"samples/captures/{name}.pcap" for address, name in names.items()}
    return merging.merge(files, tmp_path_factory.mktemp("rovers"))


def shown(path):
    """What the page shows of a capture."""
    source = open_files([path])
    bench = Settings([ROOT / "samples/missions/rover_ground.yaml"]).workbench(source.info, [path])
    context = bench.columns.context
    sink = FoxgloveSink(context, bench.types, source.info, ANY)
    examination = Examination(context)
    examination.listing = True
    with reading(source, bench) as loop:
        for rows in loop:
            sink.write(rows.batch, rows.columns)
            examination.add(rows.batch, rows.columns)
    sink.close(SourceStatistics())
    return sink._monitor._link.summary(), link_state._page_values(examination.diagnose())


def test_the_page_shows_each_of_two_rovers_by_itself(rovers):
    whole, parts = rovers
    link, doctor = shown(whole)
    for number, prefix, part in zip((1, 2), ("", "/sc_2"), parts, strict=True):
        own_link, own_doctor = shown(part)
        counts = {(row["link"], row["msg_id"]): row["count"] for row in own_link["routes"]}
        both = {
            (row["link"], row["msg_id"]): row["count"]
            for row in link["routes"]
            if row["spacecraft"] == number
        }
        # A second is counted when a message comes that is behind it.
        assert both == pytest.approx(counts, abs=11)
        apps = {(f"{prefix}/{item['app']}" if prefix else item["app"]) for item in own_link["events"]}
        texts = {item["app"] for item in link["events"]}
        assert {name for name in texts if name.startswith("/sc_2/") == (number == 2)} <= apps
        flows = [item for item in doctor["flows"] if item["spacecraft"] == number]
        hops = [(item["link"], hop["hop"], hop["in"], hop["lost"]) for item in flows for hop in item["hops"]]
        assert sorted(hops) == sorted(
            (item["link"], hop["hop"], hop["in"], hop["lost"])
            for item in own_doctor["flows"]
            for hop in item["hops"]
        )
        problems = [item for item in doctor["problems"] if item["text"].startswith(f"spacecraft {number}: ")]
        assert [messages_of(item) for item in problems] == [
            messages_of(item) for item in own_doctor["problems"]
        ]
        assert any(map(messages_of, problems))


def messages_of(problem):
    return [(item["time_ns"], item["msg_id"], item["what"]) for item in problem["messages"]]
