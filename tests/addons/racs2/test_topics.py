"""RACS2 in a recording: the messages that its ROS side publishes or takes, and the values in their bodies."""

import struct

import pytest
from racs2_peer import Talk, to_cfs, to_ros
from rosbags.highlevel import AnyReader
from streams import write_segments

from edoras_tools.addons.foxglove.server.server import ServerOptions
from edoras_tools.addons.foxglove.server.sink import FoxgloveSink
from edoras_tools.addons.racs2 import sending as racs2
from edoras_tools.errors import RouteError
from edoras_tools.io.formats.open import open_file
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.export.reading import read
from edoras_tools.pipelines.workbench import Settings

HELLO = b"\x32\x05hello"  # string_data, field 6
DOUBLES = b"\x52\x10" + struct.pack("<2d", 1.5, -2)  # float64_array_data, field 10
MISSION = """\
ground:
  ros__parameters:
    communication: {bridge_port: 1235, fsw_port: 1234, fsw_ip: 127.0.0.1, telemetry_ip: 127.0.0.1}
    command: [cmd]
    telemetry: []
    cmd: {type: geometry_msgs/msg/Twist, topic: /claimed, mid: 0x1827}
"""


@pytest.fixture
def recorded(tmp_path):
    def make(*payloads, **options):
        talk = Talk()
        for payload in payloads:
            side = talk.ros if 0 < payload[0] < 0x20 else talk.cfs
            side.send_binary(payload)
            talk.pass_on()
        write_segments(tmp_path / "x.pcap", talk.segments)
        config = tmp_path / "m.yaml"
        config.write_text(MISSION)
        target = Target(tmp_path / "x.mcap", replace=True, **options)
        record(open_file(tmp_path / "x.pcap"), Settings([config]).workbench(), target)
        with AnyReader([target.path]) as reader:  # rosbags knows the types by their schemas only
            return [
                (found.topic, found.msgtype, reader.deserialize(data, found.msgtype))
                for found, _, data in reader.messages()
                if not found.topic.startswith("/edoras/")
            ]

    return make


def test_the_ros_sides_messages_are_on_their_topics(recorded):
    found = recorded(
        to_ros("/Recv/RACS2Bridge", HELLO),
        to_cfs(0x1894, HELLO),
        to_ros("chatter", bytes(range(128))),
        to_cfs(0x1895, b""),
        to_ros("/stale\0/rest", HELLO),
    )
    users = [
        (topic, item.cfs_message_id, item.body_data_length, item.body_data.tobytes())
        for topic, kind, item in found
        if kind == racs2.USER_TYPE
    ]
    assert users == [
        ("/Recv/RACS2Bridge", 0, 128, HELLO.ljust(128, b"\0")),
        ("/RACS2Bridge", 0x1894, 7, HELLO),
        ("/chatter", 0, 128, bytes(range(128))),
        ("/RACS2Bridge", 0x1895, 0, b""),
        ("/stale", 0, 128, HELLO.ljust(128, b"\0")),
    ]


def test_values_are_messages_of_std_msgs(recorded):
    varint = b"\x20\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01"  # int32_data: -1
    found = recorded(
        to_ros("/a", HELLO + DOUBLES), to_cfs(0x1894, b"\x08\x01"), to_ros("/a", varint), to_ros("/a", HELLO)
    )
    told = [(topic, kind, item.data) for topic, kind, item in found if topic.startswith("/racs2/")]
    assert [(topic, kind) for topic, kind, _ in told] == [
        ("/racs2/a/string_data", "std_msgs/msg/String"),
        ("/racs2/a/float64_array_data", "std_msgs/msg/Float64MultiArray"),
        ("/racs2/msg_id_1894/bool_data", "std_msgs/msg/Bool"),
        ("/racs2/a/int32_data", "std_msgs/msg/Int32"),
        ("/racs2/a/string_data", "std_msgs/msg/String"),
    ]
    assert told[1][2].tolist() == [1.5, -2]
    assert [data for *_, data in (told[0], told[2], told[3], told[4])] == ["hello", True, -1, "hello"]


@pytest.mark.parametrize(
    "name",
    [
        "/edoras/events",
        "/tf",
        "/claimed",
        "/racs2/a/string_data",
        "~/own",
        "/two//slashes",
        "/a__b",
        "/RACS2Bridge",
    ],
)
def test_a_name_that_is_used_or_none_has_no_topic(recorded, name):
    found = recorded(to_ros(name, HELLO), to_ros("/good", b"?"))
    assert [topic for topic, kind, _ in found if kind == racs2.USER_TYPE] == ["/good"]


def test_a_number_that_its_field_cannot_hold_is_no_message(recorded):
    found = recorded(to_ros("/a", b"\x20\xff\xff\xff\xff\xff\x01"))
    assert [topic for topic, *_ in found] == ["/a"]


def test_topics_are_limited(recorded, monkeypatch):
    monkeypatch.setattr(racs2, "MOST_TOPICS", 5)
    found = recorded(*(to_ros(f"/topic_{number}", HELLO) for number in range(9)), to_ros("/topic_0", b""))
    assert len({topic for topic, *_ in found}) == 5
    assert [topic for topic, *_ in found].count("/topic_0") == 2


def test_export_finds_the_topics_that_only_the_capture_names(recorded, tmp_path):
    recorded(to_ros("/a", HELLO), to_ros("/a", DOUBLES), to_cfs(0x1894, b"\x08\x01"))
    for name in ("x.pcap", "x.mcap"):
        tables = read(tmp_path / name)
        found = {
            topic: tables[topic] for topic in ("/racs2/a/string_data", "/racs2/msg_id_1894/bool_data", "/a")
        }
        assert {topic: len(table) for topic, table in found.items()} == dict(
            zip(found, (1, 1, 2), strict=True)
        )
        (sizes,) = (item for item in found["/a"].columns if item.name == "body_data_length")
        assert sizes.values.tolist() == [128, 128]
        with pytest.raises(RouteError, match="no topic"):
            tables["/none"]


def test_a_live_view_offers_the_topics_when_they_come(recorded, tmp_path):
    recorded(to_ros("/a", HELLO))
    bench = Settings().workbench()
    source = open_file(tmp_path / "x.pcap")
    options = ServerOptions(Endpoint("127.0.0.1", 0))
    sink = FoxgloveSink(bench.columns.context, bench.types, source.info, options)
    try:
        before = len(sink.server._channels)
        for batch in source.batches():
            sink.write(batch, bench.columns.decode(batch))
        offered = [(item["topic"], item["schemaName"]) for item in sink.server._channels[before:]]
        assert offered == [("/a", racs2.USER_TYPE), ("/racs2/a/string_data", "std_msgs/msg/String")]
        sink.restart()
    finally:
        sink.close(source.statistics)
        source.close()
