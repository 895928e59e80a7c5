"""Latched topics in recordings that are written in parts: each part begins with their last messages."""

from __future__ import annotations

from contextlib import closing
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from places import MISSIONS, ROOT

from edoras_tools.io.formats.open import open_file
from edoras_tools.io.topics import streams as module
from edoras_tools.io.topics.streams import MissionClock
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.capture.record import Target, open_sink
from edoras_tools.pipelines.workbench import Settings

SECOND = 1_000_000_000
NOW = 1_795_000_000 * SECOND


def rows(*packets):
    """Packets as (link, processor, capture time, mission time)."""
    link, processor, captured, mission = zip(*packets, strict=True) if packets else ((), (), (), ())
    columns = SimpleNamespace(
        link=np.array(link, dtype=np.uint8),
        processor_id=np.array(processor, dtype=np.uint32),
        mission_time_ns=np.array(mission, dtype=np.int64),
    )
    return np.array(captured, dtype=np.int64), columns


def one_by_one(packets):
    """The rule, a packet at a time."""
    state, published = {}, []
    for link, processor, captured, mission in packets:
        if mission <= 0:
            published.append(captured)
            continue
        offset = captured - mission
        least, last = state.get((link, processor), (offset, offset))
        least = offset if abs(offset - last) > 5 * SECOND else min(least, offset)
        state[link, processor] = least, offset
        published.append(mission + least)
    return published


PACKETS = st.lists(
    st.tuples(
        st.sampled_from([2, 3]),
        st.sampled_from([0, 1, 70_000]),
        st.integers(0, 20 * SECOND).map(lambda value: NOW + value),
        st.one_of(st.just(-1), st.just(0), st.integers(1, 20 * SECOND).map(lambda value: 10**15 + value)),
    ),
    max_size=30,
)


@given(PACKETS, st.integers(0, 30), st.sampled_from([0, 128]))
def test_columns_follow_the_rule_however_the_packets_are_cut_into_batches(packets, cut, few):
    clock = MissionClock()
    parts = packets[:cut], packets[cut:]
    with mock.patch.object(module, "_FEW", few):
        published = [time for part in parts for time in clock.publish_times(*rows(*part)).tolist()]
    assert published == one_by_one(packets)


def test_delay_does_not_move_the_offset_and_a_restart_does():
    clock = MissionClock()
    packets = [(2, 0, NOW, 1000 * SECOND), (2, 0, NOW + 9 * SECOND // 10, 1000 * SECOND + SECOND // 2)]
    assert clock.publish_times(*rows(*packets)).tolist() == [NOW, NOW + SECOND // 2]
    assert clock.offsets() == {"to/0": NOW - 1000 * SECOND}
    assert clock.publish_times(*rows((2, 0, NOW + 60 * SECOND, SECOND))).tolist() == [NOW + 60 * SECOND]
    assert clock.offsets() == {"to/0": NOW + 59 * SECOND}


def test_no_packet_is_published_after_it_was_captured():
    random = np.random.default_rng(5)
    captured = NOW + np.cumsum(random.integers(0, SECOND, 1000))
    packets = [(2, 0, time, time - NOW + random.integers(0, SECOND)) for time in captured.tolist()]
    times, columns = rows(*packets)
    assert (MissionClock().publish_times(times, columns) <= times).all()


CAPTURE = ROOT / "samples/captures/a_rover.pcap"
PLAIN = (MISSIONS / "rover_ground.yaml").read_text()
POSE = '      topic: "telemetry_pose"\n'


def latched(text):
    return text.replace(POSE, f"{POSE}      qos: {{durability: transient_local}}\n")


def renamed(text):
    return text.replace(POSE, '      topic: "robot_1/robot_description"\n')


def messages(path, topic):
    with path.open("rb") as file:
        return [message for _, _, message in make_reader(file).iter_messages([topic], log_time_order=False)]


@pytest.fixture
def parts(tmp_path):
    """A function: the files of a recording with a mission, and the topic of its telemetry."""

    def write(text, step=10_000, **options):
        (tmp_path / "mission.yaml").write_text(text)
        bench = Settings([tmp_path / "mission.yaml"]).workbench()
        with closing(open_file(CAPTURE)) as source:
            (batch,) = source.batches()
            sink = open_sink(Target(tmp_path / "x.mcap", **{"split_count": 400, **options}), source, bench)
        for start in range(0, len(batch), step):
            piece = batch.take(slice(start, min(start + step, len(batch))))
            sink.write(piece, bench.columns.decode(piece))
        sink.close(SourceStatistics())
        return sink.paths, next(route.topic for route in bench.mission.routes if route.msg_id == 0x827)

    return write


@pytest.mark.quick("latched-33")
@pytest.mark.parametrize("step", [10_000, 33])
@pytest.mark.parametrize("change", [latched, renamed])
def test_each_part_begins_with_the_last_message(change, step, parts):
    paths, topic = parts(change(PLAIN), step)
    assert len(paths) == 5
    of_part = [messages(path, topic) for path in paths]
    for path, before, after in zip(paths[1:], of_part, of_part[1:], strict=False):
        last, again = before[-1], after[0]
        assert (again.data, again.sequence, again.publish_time) == (
            last.data,
            last.sequence,
            last.publish_time,
        )
        assert again.log_time == messages(path, "/edoras/datagrams")[0].log_time
    assert sum(map(len, of_part)) == 63 + 4
    assert sum(len(messages(path, "/edoras/datagrams")) for path in paths) == 1827


def test_other_topics_are_not_repeated(parts):
    paths, topic = parts(PLAIN)
    assert sum(len(messages(path, topic)) for path in paths) == 63
    assert sum(len(messages(path, "/cmd_vel")) for path in paths) == 600


def test_it_is_not_sent_again_when_the_parts_are_converted(parts):
    """What is converted back, or exported, are the datagrams, each once."""
    paths, _ = parts(latched(PLAIN))
    frames = []
    for path in paths:
        with closing(open_file(path)) as source:
            frames += [int(time) for batch in source.batches() for time in batch.time_ns]
    with closing(open_file(CAPTURE)) as source:
        assert frames == [int(time) for batch in source.batches() for time in batch.time_ns]


def test_one_file_has_each_message_once(parts):
    (path,), topic = parts(latched(PLAIN), split_count=0)
    assert len(messages(path, topic)) == 63
