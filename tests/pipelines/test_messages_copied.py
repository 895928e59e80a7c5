"""Recordings of other tools that were recorded again: every message as it was, judged by rosbags and mcap."""

from __future__ import annotations

from collections import Counter

import pytest
from mcap.reader import make_reader
from others import BEGIN, TOPICS, read_bag, write_bag, write_studio
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin

from edoras_tools.errors import ConfigError
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings


def copied(paths, target, period=None, **selection):
    source, bench = open_inputs(paths, Settings())
    limits = Limits(period=period) if period else Limits()
    return record(source, bench, target, selection=Selection(**selection), limits=limits)


def content(path):
    """Return everything that mcap reads of a file's messages, channels and schemas."""
    with path.open("rb") as file:
        return [
            (
                message.log_time,
                message.publish_time,
                message.sequence,
                channel.topic,
                channel.message_encoding,
                {key: text for key, text in channel.metadata.items() if text},
                schema and (schema.name, schema.encoding, schema.data),
                message.data,
            )
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_copy_is_read_as_the_original(plugin, tmp_path):
    bag = write_bag(tmp_path / "bag", plugin)
    report = copied([bag], Target(tmp_path / "a.mcap"))
    assert (report.messages, report.summary()["datagrams"]) == (205, 0)
    copied([bag], Target(tmp_path / "copy", rosbag2=True))
    with AnyReader([tmp_path / "copy"]) as reader:
        found = [
            (time_ns, item.topic, item.msgtype, bytes(data)) for item, time_ns, data in reader.messages()
        ]
        values = [reader.deserialize(data, item.msgtype) for item, _, data in reader.messages()]
    assert found == read_bag(bag)
    assert len(values) == 205
    with Reader(tmp_path / "copy") as reader:
        assert {name: item.msgcount for name, item in reader.topics.items()} == dict(
            Counter(topic for _, topic, _, _ in found)
        )


def test_nothing_of_a_message_changes(tmp_path):
    path = write_studio(tmp_path / "x.mcap")
    copied([path], Target(tmp_path / "copy.mcap"))
    assert content(tmp_path / "copy.mcap") == content(path)
    assert len(content(path)) == 100


def test_several_are_merged_in_order_of_time(tmp_path):
    inputs = [
        write_bag(tmp_path / "a"),
        write_bag(tmp_path / "b", StoragePlugin.SQLITE3, begin=BEGIN + 500_000_000),
        write_studio(tmp_path / "c.mcap"),
    ]
    copied(inputs, Target(tmp_path / "all", rosbag2=True))
    found = content(tmp_path / "all/all_0.mcap")
    times = [item[0] for item in found]
    assert times == sorted(times)
    one_by_one = []
    for number, path in enumerate(inputs):
        copied([path], Target(tmp_path / f"{number}.mcap"))
        one_by_one += content(tmp_path / f"{number}.mcap")
    key = [(item[0], item[3], item[7]) for item in found]
    assert sorted(key) == sorted((item[0], item[3], item[7]) for item in one_by_one)
    assert len(key) == 205 + 205 + 100


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"topics": ["/cmd_vel"]}, 100),
        ({"topics": ["s*", "text"]}, 54),
        ({"where": "linear.x >= 5"}, 50),
        ({"topics": ["cmd_vel"], "where": "linear.x >= 5", "period": Period(1_500_000_000)}, 25),
        ({"period": Period(500_000_000, 1_000_000_000)}, 25 + 2 * 12 + 1),
    ],
)
def test_what_is_chosen_is_copied(options, expected, tmp_path):
    bag = write_bag(tmp_path / "bag")
    report = copied([bag], Target(tmp_path / "a.mcap"), **options)
    found = content(tmp_path / "a.mcap")
    assert (report.messages, len(found)) == (expected, expected)
    said = [(time_ns, topic, data) for time_ns, topic, _, data in read_bag(bag)]
    assert [item for item in said if item in [(row[0], row[3], row[7]) for row in found]] == [
        (row[0], row[3], row[7]) for row in found
    ]
    with (tmp_path / "a.mcap").open("rb") as file:
        channels = {item.topic for item in make_reader(file).get_summary().channels.values()}
    wanted = set(TOPICS) if "topics" not in options else {row[3] for row in found}
    assert channels == wanted


def test_parts_begin_with_what_is_latched(tmp_path):
    bag = write_bag(tmp_path / "bag")
    report = copied([bag], Target(tmp_path / "p.mcap", split_count=60))
    parts = [content(path) for path in report.outputs]
    assert len(parts) == 4
    assert [[item[3] for item in part].count("/tf_static") for part in parts] == [1, 1, 1, 1]
    static = [item for part in parts for item in part if item[3] == "/tf_static"]
    assert len({item[7] for item in static}) == 1
    assert sum(map(len, parts)) == 205 + 3


def test_what_holds_datagrams_is_refused(tmp_path):
    bag = write_bag(tmp_path / "bag")
    for target, why in (
        (Target(tmp_path / "x.pcap"), "pcap holds datagrams: write .mcap, or --format rosbag2"),
        (Target(tmp_path / "x.pcapng"), "pcapng holds datagrams"),
        (Target(tmp_path / "x.mcap", transforms=True), "--tf"),
    ):
        with pytest.raises(ConfigError, match=why):
            copied([bag], target)
    assert not [*tmp_path.glob("x.*")]


def test_a_copy_of_a_copy_is_the_same(tmp_path):
    path = write_studio(tmp_path / "x.mcap")
    copied([path], Target(tmp_path / "a.mcap"))
    copied([tmp_path / "a.mcap"], Target(tmp_path / "b.mcap"))
    assert content(tmp_path / "b.mcap") == content(path)
