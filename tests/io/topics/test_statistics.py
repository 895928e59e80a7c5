from __future__ import annotations

import itertools
from collections import defaultdict
from contextlib import closing

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from msgspec.structs import replace

from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.topics.edoras import HOST_TOPIC, LinkStatistics
from edoras_tools.io.topics.messages import RECORD_BYTES
from edoras_tools.links import table
from edoras_tools.mission import Mission
from edoras_tools.model import HostCounters, SocketCounters, SourceInfo, SourceStatistics
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.sequence import SequenceCounts

SECOND = 1_000_000_000


def decode(types, messages):
    found = []
    for row in range(len(messages)):
        start = int(messages.offset[row])
        body = messages.data[start : start + int(messages.length[row])].tobytes()
        found.append(
            types.decode(
                "edoras_msgs/msg/LinkStatistics",
                messages.heads(slice(None))[row].tobytes()[RECORD_BYTES:] + body,
            )
        )
    return found


def expected(batch, columns, routes):
    """What each second amounts to, a datagram at a time; in order of second, link and MsgId."""
    groups = defaultdict(lambda: {"count": 0, "bytes": 0, "largest": 0, "gaps": 0})
    told, second = SequenceCounts().follow(batch, columns), 0
    for row in range(len(batch)):
        link, msg_id = int(columns.link[row]), int(columns.msg_id[row])
        second = max(second, int(batch.time_ns[row] - batch.time_ns[0]) // SECOND)
        group = groups[second, link, msg_id]
        size = int(batch.length[row])
        group["count"] += 1
        group["bytes"] += size
        group["largest"] = max(group["largest"], size)
        group["gaps"] += int(told.missing[row] - told.refilled[row])
    for (_, link, msg_id), group in sorted(groups.items()):
        label = table.link(link).label
        other = f"{label}/0x{msg_id:04x}" if msg_id >= 0 else label
        group["gaps"] = max(group["gaps"], 0)
        yield {"link": link, "msg_id": msg_id, "topic": routes.get((link, msg_id), other), **group}


@settings(deadline=None)
@given(st.integers(1, 120), st.integers(0, 1000), st.lists(st.integers(0, 120), max_size=3), st.booleans())
def test_it_adds_up_however_the_batches_are_cut(types, mission, made_up, count, seed, cuts, back):
    batch, columns = made_up(seed, [100] * count, step_ns=SECOND // 2)
    columns = replace(columns, sequence_count=columns.sequence_count % np.uint16(9))
    if back:
        batch = replace(batch, time_ns=np.append(batch.time_ns[:1], batch.time_ns[::-1][:-1]))
    routes = {(int(route.link), route.msg_id): route.topic for route in mission.routes}
    statistics = LinkStatistics(mission, SourceStatistics(kernel_drops=5))
    found = []
    edges = sorted({0, count, *(cut for cut in cuts if cut < count)})
    for first, last in itertools.pairwise(edges):
        part = slice(first, last)
        found += decode(types, statistics.messages(batch.take(part), columns.take(part), 9))
    found += decode(types, statistics.finish(9))
    wanted = list(expected(batch, columns, routes))
    assert [{key: item[key] for key in wanted[0]} for item in found] == wanted
    assert all(item["kernel_drops"] == 5 and item["rate_hz"] == item["count"] for item in found)


def test_a_message_stands_before_the_first_datagram_after_its_second(types, mission, made_up):
    batch, columns = made_up(1, [50] * 4)
    start = 1_700_000_000 * SECOND
    batch = replace(batch, time_ns=start + np.array([0, 1, 10 * SECOND, 10 * SECOND + 1]))
    columns = replace(columns, link=np.ones(4, np.uint8), msg_id=np.full(4, 0x1827, np.int32))
    statistics = LinkStatistics(mission, None)
    messages = statistics.messages(batch, columns, 9)
    assert messages.rows.tolist() == [2]
    assert messages.heads(slice(None))["log_time"].tolist() == [start + SECOND]
    (values,) = decode(types, messages)
    assert (values["topic"], values["count"]) == ("/cmd_vel", 2)
    rest = statistics.finish(9)
    assert rest.heads(slice(None))["log_time"].tolist() == [start + 10 * SECOND + 1]
    assert len(statistics.finish(9)) == 0


NOON = 1_700_000_000_123_456_789
READINGS = [
    HostCounters(
        NOON, (SocketCounters(1234, "127.0.0.1", 7, 512, 80),), 93, 5, 13, 105, 6, 10, 1 << 18, 1 << 22
    ),
    HostCounters(NOON + 10**9, (SocketCounters(2234, "::1", 1 << 40, 0, 0),) * 3),
]


def test_what_the_kernel_counted_is_in_the_recording_as_it_was(tmp_path):
    path = tmp_path / "a.mcap"
    types = TypeStore()
    sink = McapSink(path, Mission(), types, SourceInfo("lo", "live"))
    for reading in READINGS:
        sink.write_host(reading)
    sink.close(SourceStatistics())
    with path.open("rb") as file:
        told = [
            (message.log_time, types.decode(schema.name, message.data))
            for schema, _, message in make_reader(file).iter_messages([HOST_TOPIC])
        ]
    assert [time_ns for time_ns, _ in told] == [reading.time_ns for reading in READINGS]
    assert told[0][1]["sockets"][0] == {
        "inode": 7,
        "drops": 80,
        "queued": 512,
        "port": 1234,
        "address": "127.0.0.1",
    }
    assert (told[0][1]["msg_max"], told[1][1]["msg_max"]) == (10, -1)
    with closing(McapSource(path)) as source:
        assert source.host() == READINGS
