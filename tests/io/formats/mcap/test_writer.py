from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from edoras_tools.errors import CaptureError, RouteError
from edoras_tools.io import RecordingOptions
from edoras_tools.io.formats.mcap import chunks as mcap_chunks
from edoras_tools.io.formats.mcap.file import McapFile
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.topics.messages import NO_MESSAGE
from edoras_tools.links.bare import CI, TO
from edoras_tools.mission.model import Mission, Route
from edoras_tools.model import Columns, Finding, SourceStatistics

OWN = {"/edoras/datagrams", "/edoras/events", "/edoras/software_bus", "/edoras/link_statistics"}
HOUSEKEEPING = {
    *(f"/cfs/CFE_{name}_HousekeepingTlm" for name in ("ES", "EVS", "TBL", "TIME")),
    *("/cfs/TO_LAB_HkTlm", "/cfs/CI_LAB_HkTlm"),
}
ROBOT = {"/cfs/robot_command", "/cfs/robot_state"}


def record(path, mission, types, info, pairs, statistics=None, **options):
    sink = McapSink(path, mission, types, info, RecordingOptions(**options))
    for batch, columns in pairs:
        sink.write(batch, columns)
    sink.close(statistics or SourceStatistics())
    return sink


def messages(path, topic=None):
    """All messages as the mcap library reads them, in the order of the file, and its summary."""
    with Path(path).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [
            (channel.topic, message)
            for _, channel, message in reader.iter_messages(topics=topic, log_time_order=False)
        ]
    return found, summary


def test_a_rover_holds_what_was_sent(tmp_path, types, capture):
    rover = capture("a_rover", "rover_ground")
    path = tmp_path / "a.mcap"
    record(path, rover.mission, types, rover.info, rover.pairs, rover.statistics)
    _, summary = messages(path)
    counts = {
        summary.channels[channel].topic: count
        for channel, count in summary.statistics.channel_message_counts.items()
    }
    assert counts.pop("/edoras/link_statistics") > 65
    assert counts == dict.fromkeys(HOUSEKEEPING, 63) | {
        "/cmd_vel": 600,
        "/telemetry_pose": 63,
        "/cfs/TO_LAB_EnableOutputCmd": 1,
        "/cfs/robot_command": 508,
        "/cfs/robot_state": 64,
        "/edoras/datagrams": 1827,
        "/edoras/events": 15,
        "/edoras/software_bus": 63,
    }


def test_rosbags_reads_every_message_of_every_schema(tmp_path, types, capture):
    rover = capture("a_rover", "rover_ground")
    path = tmp_path / "a.mcap"
    record(path, rover.mission, types, rover.info, rover.pairs)
    seen = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            seen.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    commands = {"/cmd_vel", "/cfs/TO_LAB_EnableOutputCmd"}
    assert {*seen} == OWN | HOUSEKEEPING | ROBOT | commands | {"/telemetry_pose"}
    table = seen["/cfs/CFE_TBL_HousekeepingTlm"][-1]
    assert (table.last_updated_table, table.tables, table.header.msg_id) == ("SBN.SBN_RemapTbl", 4, 0x0804)
    assert [item.app_id & 0xFF for item in seen["/cfs/CFE_EVS_HousekeepingTlm"][-1].app_data][:3] == [1, 2, 3]
    twist = seen["/cmd_vel"][2]
    assert (twist.linear.x, twist.angular.z) == (0.5099833416646828, 0.19900083305560518)
    pose = seen["/telemetry_pose"][2]
    assert (pose.header.frame_id, pose.pose.position.y, pose.pose.orientation.w) == ("world", 0.5, 1.0)
    event = next(item for item in seen["/edoras/events"] if item.level == 40)
    assert (event.name, event.function, event.line, event.file) == ("CFE_SB", "66/1", 17, "")
    assert event.msg == "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"
    last = seen["/edoras/software_bus"][-1]
    batch, columns = rover.pairs[0]
    packet = batch[np.flatnonzero(columns.msg_id == 0x0803)[-1]].payload
    assert (last.message_limit_error_counter, last.link) == (int.from_bytes(packet[30:32], "little"), TO)
    assert last.memory_in_use == int.from_bytes(packet[36:40], "little")
    datagram = seen["/edoras/datagrams"][2]
    assert bytes(datagram.frame) == batch[2].frame
    assert (datagram.number, datagram.link, datagram.msg_id) == (3, columns.link[2], columns.msg_id[2])
    assert bytes(datagram.source_address) == b"\0" * 10 + b"\xff\xff\x7f\0\0\x01"
    assert sum(item.count for item in seen["/edoras/link_statistics"]) == 1827


def test_channels_say_where_their_messages_come_from(tmp_path, types, mission, info):
    path = tmp_path / "a.mcap"
    record(path, mission, types, info, [])
    _, summary = messages(path)
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert channels["/cmd_vel"].metadata == {
        "offered_qos_profiles": "",
        "link": "ci",
        "msg_id": "0x1827",
        "direction": "command",
    }
    assert {channel.message_encoding for channel in channels.values()} == {"cdr"}
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert {schema.encoding for schema in schemas.values()} == {"ros2msg"}
    assert b"MSG: geometry_msgs/Point" in schemas["geometry_msgs/msg/PoseStamped"].data
    assert summary.statistics.message_count == 0


def test_metadata_and_attachments(tmp_path, types, mission, info, made_up):
    path = tmp_path / "a.mcap"
    statistics = SourceStatistics(kernel_drops=3, skipped=7)
    record(path, mission, types, info, [made_up(1, [100] * 50)], statistics, filter="msg_id == 0x827")
    with path.open("rb") as file:
        reader = make_reader(file)
        records = {item.name: item.metadata for item in reader.iter_metadata()}
        attachments = list(reader.iter_attachments())
    metadata = records["edoras"]
    assert {key: metadata[key] for key in ("source", "filter", "kernel_drops", "skipped", "datagrams")} == {
        "source": "made up",
        "filter": "msg_id == 0x827",
        "kernel_drops": "3",
        "skipped": "7",
        "datagrams": "50",
    }
    assert (metadata["time_resolution_ns"], metadata["snap_length"]) == ("1000", "65535")
    assert json.loads(metadata["findings"])["capture_cut"] == 1 << 26
    assert {key.split("/")[0] for key in json.loads(metadata["clock_offset_ns"])} <= {
        "ci",
        "to",
        "sbn",
        "other",
    }
    assert records["edoras_opening"].items() <= metadata.items()
    assert [(item.name, item.media_type, item.data) for item in attachments] == [
        ("rover.yaml", "application/yaml", b"node: {}\n")
    ]


def test_times_before_1970(tmp_path, types, mission, info, made_up):
    path = tmp_path / "a.mcap"
    record(path, mission, types, info, [made_up(1, [100] * 50, start_ns=-1_000_000_000)])
    with path.open("rb") as file:
        reader = make_reader(file)
        assert [item.log_time for item in reader.iter_attachments()] == [0]
        assert sum(1 for _ in reader.iter_messages(["/edoras/datagrams"])) == 50


def expected_messages(batch, columns, mission):
    """What must be recorded, a datagram at a time: topic, log time, sequence and the bytes or values."""
    for row in range(len(batch)):
        datagram = batch[row]
        yield "/edoras/datagrams", datagram, row
        if columns.route[row] < 0 or columns.cdr_length[row] <= 0 or columns.findings[row] & NO_MESSAGE:
            continue
        start = columns.cdr_offset[row]
        cdr = batch.data[start : start + columns.cdr_length[row]].tobytes()
        yield mission.routes[columns.route[row]].topic, cdr, row


BATCHES = st.lists(
    st.lists(st.one_of(st.integers(0, 300), st.sampled_from([0, 1, 255, 1514, 3000, 70_000])), max_size=25),
    max_size=4,
)


@settings(max_examples=examples(60), deadline=None)
@given(BATCHES, st.integers(0, 1 << 20), st.sets(st.integers(0, 3)), st.sampled_from([1, 4096, 1 << 20]))
def test_any_batches_come_back(
    tmp_path_factory, types, mission, info, made_up, shapes, seed, flushes, chunk_bytes
):
    path = tmp_path_factory.mktemp("any") / "any.mcap"
    pairs = [made_up(seed + index, lengths) for index, lengths in enumerate(shapes)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_chunks, "CHUNK_BYTES", chunk_bytes)
        sink = McapSink(path, mission, types, info)
        for index, (batch, columns) in enumerate(pairs):
            sink.write(batch, columns)
            if index in flushes:
                sink.flush()
        sink.close(SourceStatistics())
    found, summary = messages(path)
    found = [(topic, message) for topic, message in found if topic != "/edoras/link_statistics"]
    wanted = [(pair, item) for pair in pairs for item in expected_messages(*pair, mission)]
    assert len(found) == len(wanted)
    assert summary.statistics.message_count >= len(found)
    for (topic, message), ((batch, columns), (wanted_topic, content, row)) in zip(found, wanted, strict=True):
        assert topic == wanted_topic
        assert message.log_time == batch.time_ns[row]
        assert message.sequence == columns.sequence_count[row]
        assert message.publish_time <= message.log_time
        if topic != "/edoras/datagrams":
            assert message.data == content
            continue
        values = types.decode("edoras_msgs/msg/Datagram", message.data)
        assert bytes(values["frame"]) == content.frame
        assert (values["number"], values["link_type"]) == (content.number, content.link_type)
        assert values["original_length"] == content.original_length
        assert (values["payload_offset"], values["payload_length"]) == (
            content.payload_offset,
            len(content.payload),
        )
        assert (values["source_port"], values["destination_port"]) == (
            content.source.port,
            content.destination.port,
        )
        assert (values["link"], values["findings"]) == (columns.link[row], columns.findings[row])
        address = batch.source_address[row]
        mapped = (
            bytes(10) + b"\xff\xff" + int(address).to_bytes(4, "big")
            if batch.ip_version[row] == 4
            else batch.ipv6[address]
        )
        assert bytes(values["source_address"]) == mapped


def test_indexes_find_every_message_and_time_range(tmp_path, types, mission, info, made_up, monkeypatch):
    monkeypatch.setattr(mcap_chunks, "CHUNK_BYTES", 4096)
    path = tmp_path / "a.mcap"
    batch, columns = made_up(3, [120] * 400)
    record(path, mission, types, info, [(batch, columns)])
    middle = (int(batch.time_ns[100]), int(batch.time_ns[300]))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        times = [
            message.log_time
            for _, _, message in reader.iter_messages(
                topics=["/edoras/datagrams"], starting_at=middle[0], ending_before=middle[1]
            )
        ]
        assert len(summary.chunk_indexes) > 10
    assert times == [time for time in batch.time_ns.tolist() if middle[0] <= time < middle[1]]
    with path.open("rb") as file:
        streamed = [
            item
            for item in StreamReader(file, validate_crcs=True).records
            if type(item).__name__ == "Message"
        ]
    assert len(streamed) == summary.statistics.message_count


@pytest.mark.parametrize("finding", [bit for bit in Finding if bit & NO_MESSAGE])
def test_no_ros_message_where_it_is_not_whole(tmp_path, types, mission, info, made_up, finding):
    batch, columns = made_up(4, [100] * 20)
    values = {name: getattr(columns, name) for name in Columns.__struct_fields__}
    values["findings"] = np.full(20, finding, dtype=np.uint32)
    path = tmp_path / "a.mcap"
    record(path, mission, types, info, [(batch, Columns(**values))])
    found, _ = messages(path)
    assert {topic for topic, _ in found} == {"/edoras/datagrams", "/edoras/link_statistics"}


def test_datagrams_can_be_left_out(tmp_path, types, mission, info, made_up):
    path = tmp_path / "a.mcap"
    record(path, mission, types, info, [made_up(4, [100] * 20)], datagrams=False)
    found, summary = messages(path)
    assert "/edoras/datagrams" not in {channel.topic for channel in summary.channels.values()}
    assert found


def test_split_by_time_and_every_file_is_whole(tmp_path, types, mission, info, made_up):
    batch, columns = made_up(5, [100] * 300, step_ns=100_000_000)
    sink = record(tmp_path / "a.mcap", mission, types, info, [(batch, columns)], split_ns=2_000_000_000)
    assert [file.path.name for file in sink.files] == [f"a_{index}.mcap" for index in range(len(sink.files))]
    assert len(sink.files) > 3
    numbers = []
    for file in sink.files:
        found, summary = messages(file.path)
        times = [message.log_time for topic, message in found if topic == "/edoras/datagrams"]
        assert 0 <= max(times) - min(times) < 2_000_000_000
        assert summary.statistics.attachment_count == 1
        numbers += [
            types.decode("edoras_msgs/msg/Datagram", message.data)["number"]
            for topic, message in found
            if topic == "/edoras/datagrams"
        ]
    assert numbers == list(range(1, 301))


def test_split_by_size(tmp_path, types, mission, info, made_up):
    pairs = [made_up(seed, [500] * 400) for seed in range(3)]
    sink = record(tmp_path / "a.mcap", mission, types, info, pairs, split_bytes=100_000)
    sizes = [file.path.stat().st_size for file in sink.files]
    assert len(sizes) > 4
    assert max(sizes) < 160_000
    assert min(sizes[:-1]) > 70_000
    assert sum(file.summary.counts[1] for file in sink.files) == 1200


def test_a_very_small_size_does_not_cost_a_look_for_each_datagram(tmp_path, types, mission, info, made_up):
    """Live, who looks that often falls behind, and loses what waits when it is killed."""
    pairs = [made_up(seed, [100] * 640) for seed in range(2)]
    sink = record(tmp_path / "a.mcap", mission, types, info, pairs, split_bytes=1)
    counts = [file.summary.counts[1] for file in sink.files]
    assert counts == [64] * 20


def test_a_chunk_is_in_the_file_after_flush(tmp_path, types, mission, info, made_up):
    path = tmp_path / "a.mcap"
    sink = McapSink(path, mission, types, info)
    sink.write(*made_up(6, [100] * 10))
    sink.flush()
    kinds = []
    with path.open("rb") as file, pytest.raises(EndOfFile):
        kinds.extend(
            type(item).__name__ for item in StreamReader(file, emit_chunks=True, validate_crcs=True).records
        )
    assert kinds.index("Chunk") < kinds.index("MessageIndex")
    sink.flush()
    assert path.stat().st_size == sink.files[0].size
    sink.close(SourceStatistics())
    sink.close(SourceStatistics())


def test_where_it_cannot_be_written(tmp_path, types, mission, info):
    with pytest.raises(CaptureError, match="cannot be created: Is a directory"):
        McapSink(tmp_path, mission, types, info)
    with pytest.raises(CaptureError, match="No such file"):
        McapSink(tmp_path / "no" / "a.mcap", mission, types, info)


def test_a_full_disk_is_one_error_and_closing_afterwards_is_none(
    tmp_path, types, mission, info, made_up, monkeypatch
):
    sink = McapSink(tmp_path / "a.mcap", mission, types, info)

    def full(self, *pieces):
        raise self._failure(OSError(28, "No space left on device"))

    monkeypatch.setattr(McapFile, "add_bytes", full)
    with pytest.raises(CaptureError, match=r"No space left on device; `edoras recover .*a\.mcap`"):
        sink.write(*made_up(7, [100] * 10))
    sink.close(SourceStatistics())
    with pytest.raises(CaptureError, match="failed"):
        sink.write(*made_up(7, [100] * 10))


def test_a_disk_that_fills_up_while_chunks_are_under_way(
    tmp_path, types, mission, info, made_up, monkeypatch
):
    sink = McapSink(tmp_path / "a.mcap", mission, types, info)
    sink.write(*made_up(7, [100] * 10))

    def full(self, *pieces):
        raise self._failure(OSError(28, "No space left on device"))

    monkeypatch.setattr(McapFile, "add_bytes", full)
    with pytest.raises(CaptureError, match="No space left"):
        sink.flush()
    sink.close(SourceStatistics())


def test_dev_full_is_reported(types, mission, info, made_up):
    with pytest.raises(CaptureError, match="No space left"):
        McapSink("/dev/full", mission, types, info)


def test_an_unknown_type_is_refused_before_a_file_is_made(tmp_path, types, info):
    mission = Mission(routes=(Route("/x", "no_msgs/msg/Such", 0x1830, CI, "command"),))
    with pytest.raises(RouteError):
        McapSink(tmp_path / "a.mcap", mission, types, info)
    assert not (tmp_path / "a.mcap").exists()
