"""Messages of recordings without datagrams: many at once and one by one, beside rosbags' values."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from others import STORE, TOPICS, messages, read_bag, values_of, write_bag, write_studio
from rosbags.rosbag2 import StoragePlugin

from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.decode.lines import PacketLines, line_of
from edoras_tools.errors import RouteError
from edoras_tools.model import OTHER, Finding
from edoras_tools.pipelines.capture.packet_json import PacketTexts, as_json
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings


def read(path, **selection):
    source, bench = open_inputs([path], Settings())
    return bench, [
        rows.take(np.arange(len(rows)))
        for rows in selected_rows(source, bench, selection=Selection(**selection))
    ]


@pytest.fixture(scope="module", params=["db3", "mcap", "studio"])
def recording(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    if request.param == "studio":
        return write_studio(folder / "x.mcap")
    plugin = StoragePlugin.MCAP if request.param == "mcap" else StoragePlugin.SQLITE3
    return write_bag(folder / "bag", plugin)


def test_many_at_once_are_as_one_by_one(recording):
    bench, parts = read(recording)
    lines, texts = PacketLines(bench.columns.context), PacketTexts(bench.columns.context)
    for rows in parts:
        packets = [bench.dissector.dissect(rows.batch[row]) for row in rows.indices().tolist()]
        assert list(lines.of(rows)) == [line_of(decoded) for decoded in packets]
        expected = [
            json.dumps({"schema": 1, **as_json(decoded)}, separators=(",", ":")) for decoded in packets
        ]
        assert texts.of(rows) == expected
        assert rows.column("findings").tolist() == [int(decoded.findings) for decoded in packets]


def test_values_are_those_that_rosbags_reads(tmp_path):
    path = write_bag(tmp_path / "bag")
    bench, parts = read(path)
    found = [json.loads(text) for rows in parts for text in PacketTexts(bench.columns.context).of(rows)]
    said = read_bag(path)
    assert [(item["time_ns"], item["topic"], item["type"], item["length"]) for item in found] == [
        (time_ns, topic, kind, len(data)) for time_ns, topic, kind, data in said
    ]
    values = [values_of(STORE.deserialize_cdr(data, kind)) for _, _, kind, data in said]
    assert [item["message"] for item in found] == json.loads(json.dumps(values))
    assert {item["link"] for item in found} == {item["source"] for item in found} == {None}


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("text", "passes"),
    [
        ("linear.x > 5", lambda topic, value, _: topic == "/cmd_vel" and value.linear.x > 5),
        (
            "points[1].z == 20",
            lambda topic, value, _: topic == "/custom" and len(value.points) > 1 and value.points[1].z == 20,
        ),
        ("quad[3] in {4, 8}", lambda topic, value, _: topic == "/custom" and value.quad[3] in {4, 8}),
        (
            "len(values) == 4 and flag == true",
            lambda topic, value, _: topic == "/custom" and len(value.values) == 4 and value.flag,
        ),
        ('data contains "5"', lambda topic, value, _: topic == "/text" and "5" in value.data),
        ("transforms.transform.translation.z == 3", lambda topic, *_: topic == "/tf_static"),
        ("topic == /scan", lambda topic, *_: topic == "/scan"),
        ("type == Twist", lambda topic, *_: topic == "/cmd_vel"),
        ("time < 0.5", lambda _, __, seconds: seconds < 0.5),
        ("not ros", lambda *_: False),
    ],
)
def test_filters_over_fields(text, passes, tmp_path):
    path = write_bag(tmp_path / "bag")
    _, parts = read(path, where=text)
    found = [int(item) for rows in parts for item in rows.datagram("number")]
    expected = [
        number
        for number, (time_ns, topic, value) in enumerate(messages(), 1)
        if passes(topic, value, (time_ns - 1_790_000_000_000_000_000) / 1e9)
    ]
    assert found == expected


def test_a_filter_is_the_same_one_by_one(recording):
    bench, parts = read(recording)
    for text in ("linear.x > 2", "length > 50", "topic == /cmd_vel", "ros", "inner.n >= 5"):
        try:
            where = Where(text, bench.columns.context)
        except WhereError:
            assert text == "inner.n >= 5"
            continue
        for rows in parts:
            packets = [bench.dissector.dissect(rows.batch[row]) for row in rows.indices().tolist()]
            assert where.passing(rows).tolist() == where.judge(packets).tolist()


@pytest.mark.each(3)
@pytest.mark.parametrize(
    "name", ["msg_id", "link", "ccsds.msg_id", "source.port", "sbn.processor_id", "destination"]
)
def test_fields_of_datagrams_are_refused(name, recording):
    bench, _ = read(recording)
    with pytest.raises(WhereError, match="is of datagrams, and the recording has only messages"):
        Where(f"{name} == 1", bench.columns.context)


def test_what_cannot_be_read_stays(tmp_path):
    bench, (rows,) = read(write_studio(tmp_path / "x.mcap"))
    packets = [bench.dissector.dissect(rows.batch[row]) for row in range(5)]
    about = {decoded.layer("recorded").values()["topic"]: decoded for decoded in packets}
    assert about["/status"].message.values == {"ok": True, "n": 0, "who": {"list": [1, 2]}}
    assert (about["/proto"].message, str(about["/proto"].stop)) == (
        None,
        "protobuf, not cdr: only counted and copied",
    )
    assert str(about["/raw"].stop) == "without a schema: only counted and copied"
    assert about["/outer"].message.values["inner"] == {"x": 0.0, "n": 0}
    assert {decoded.link for decoded in packets} == {OTHER}


def test_a_message_that_is_too_short_is_told(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        text = STORE.generate_msgdef("geometry_msgs/msg/Twist")[0].encode()
        topic = writer.register_channel(
            "/cmd_vel", "cdr", writer.register_schema(TOPICS["/cmd_vel"], "ros2msg", text)
        )
        for size in (52, 51, 3, 0):
            writer.add_message(topic, size, b"\0\1\0\0".ljust(size, b"\0")[:size], size)
        writer.finish()
    bench, (rows,) = read(tmp_path / "x.mcap")
    bits = [Finding(bits) for bits in rows.column("findings").tolist()]
    assert bits == [Finding.CDR_INVALID] * 3 + [Finding(0)]  # in order of time
    packets = [bench.dissector.dissect(rows.batch[row]) for row in range(4)]
    assert [decoded.message is None for decoded in packets] == [True, True, True, False]
    assert math.isclose(packets[3].message.values["linear"]["x"], 0.0)
    assert [decoded.findings for decoded in packets] == bits


def test_an_unknown_topic_is_told(recording):
    with pytest.raises(RouteError, match="did you mean /cmd_vel"):
        read(recording, topics=["cmd_vle"])
