"""Samples that have no topic, or whose type is not known, are counted and told."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from effort import LONG
from rosbags.highlevel import AnyReader
from rtps import CAPTURES, PREFIX, TRUTH, TWIST, WRITER, announced, data, message
from rtps_batches import batch_of

from edoras_tools.addons.rtps.samples import LeftSamples, SampleMessages
from edoras_tools.addons.rtps.wire import Announcement
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.links.doors import Endpoints
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.ros import TypeStore

CDR = b"\0\1\0\0" + bytes(48)


def told(*payloads):
    """Return the notes on some datagrams."""
    decoder, left = ColumnDecoder(Context(types=TypeStore())), LeftSamples()
    for number, payload in enumerate(payloads, 1):
        batch = batch_of(payload, number=number)
        decoder.decode(batch)
        left.add(batch, np.arange(1), decoder.context.endpoints)
    return left.notes(decoder.context.types, decoder.context.endpoints)


def test_samples_are_told_by_when_their_writer_was_announced():
    one, two = message(data(1, CDR)), message(data(2, CDR), data(3, CDR))
    assert told(announced(), one, two) == []
    assert told(one, two, announced(), one) == [
        "DDS: 3 samples (and copies) came before the writer was announced: no topic"
    ]
    assert told(one, two) == [
        "DDS: 3 samples (and copies) of 1 writer that the capture does not announce: no topic"
    ]


def test_samples_of_unknown_types_are_told():
    mine = announced("rt/mine", "my::msg::dds_::Thing_")
    assert told(message(data(1, CDR)), mine, message(data(2, CDR))) == [
        "DDS: 1 sample (and copies) came before the writer was announced: no topic",
        "DDS: 1 sample of unknown types (my/msg/Thing): only bytes; --set msg-path adds types",
    ]
    assert told(announced("rq/mineRequest", "my::srv::dds_::Thing_Request_"), message(data(1, CDR))) == []


def recorded(path, target, **options):
    source = open_files([path])
    record(source, Settings().workbench(source.info), Target(target, **options))
    with AnyReader([target]) as reader:
        return [
            (item.topic, item.msgtype, time_ns, reader.deserialize(raw, item.msgtype))
            for item, time_ns, raw in reader.messages()
            if not item.topic.startswith("/edoras/")
        ]


@pytest.mark.long
def test_copies_are_known_over_any_number_of_holes():
    endpoints = Endpoints()
    endpoints.learn(Announcement(PREFIX + WRITER, "rt/cmd_vel", TWIST), 0)
    space = SimpleNamespace(types=TypeStore(), used_names=set, place=lambda *_: 7)
    samples, decoder = SampleMessages(space, endpoints), ColumnDecoder(Context())
    cdr = b"\0\1\0\0" + bytes(48)
    written = []
    last = 20_001 if LONG else 6_001
    for first in range(1, last, 400):
        payload = message(*(data(number, cdr) for number in range(first, first + 400, 2)))
        batch = batch_of(payload, payload)
        made = samples.messages(batch, decoder.decode(batch))
        written += [int(item) for part in made for item in part.heads(slice(None))["sequence"]]
    assert written == list(range(1, last, 2))


@pytest.mark.each(2)
@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.name.partition(".")[0])
def test_what_was_published_is_recorded_once(path, tmp_path):
    kind, _, end = path.name.partition(".")[0].partition("_")
    found = recorded(path, tmp_path / "all.mcap")
    count = Counter(item[:2] for item in found)
    truth = TRUTH[kind]
    heard = truth["heard"] if end == "receiver" else {}
    texts = len(heard.get("/chatter", range(truth["written"]["/chatter"])))
    assert count["/cmd_vel", "geometry_msgs/msg/Twist"] == truth["written"]["/cmd_vel"]
    assert count["/chatter", "std_msgs/msg/String"] == texts
    large = "/image" if kind == "fastdds" else "/joint_states"
    bodies = [item[3] for item in found if item[0] == large]
    stamps = [0, 25, 50, 75]
    assert [item.header.stamp.sec for item in bodies] == stamps
    for item, stamp in zip(bodies, stamps, strict=True):
        if kind == "fastdds":
            assert bytes(item.data) == bytes((place * 7 + stamp) % 256 for place in range(90_000))
        else:
            assert list(item.name) == [f"joint{stamp}"]
            assert item.position.tolist() == list(range(2500))
    twists = sorted(item[3].linear.x for item in found if item[0] == "/cmd_vel")
    assert twists == [number / 10 for number in range(truth["written"]["/cmd_vel"])]
