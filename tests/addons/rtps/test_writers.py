"""Samples by writer: what real writers and readers say themselves, and any order of what they may send."""

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT
from rtps import CAPTURES, PREFIX, TRUTH, WRITER, data, made, message
from rtps_batches import batch_of
from schema import check, published

from edoras_tools.addons.rtps.wire import SubmessageKind
from edoras_tools.addons.rtps.writers import MOST_ASKED, SampleFollower
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.links.doors import Endpoints
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.ranges import MOST_RANGES

OTHER = bytes(range(100, 112))


def followed(path):
    source = open_files([path])
    bench = Settings().workbench(source.info)
    follower = SampleFollower(bench.columns.context.endpoints)
    with reading(source, bench) as loop:
        for rows in loop:
            follower.add(rows.batch, rows.columns)
    named = follower.topic_writers()
    return {item.topic: item.writer for item in named}


@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.name.partition(".")[0])
def test_every_sample_is_accounted_for(path):
    kind, _, end = path.name.partition(".")[0].partition("_")
    found, truth = followed(path), TRUTH[kind]
    assert set(found) == set(truth["written"])
    for topic, written in truth["written"].items():
        writer, fates = found[topic], found[topic].fates()
        heard = truth["heard"][topic]
        assert writer.written == writer.captured + sum(fates.values()) - fates["lost_behind"]
        if topic != "/chatter":  # reliable: all arrived, some at the second time
            assert (writer.written, writer.captured, len(heard)) == (written,) * 3
            assert not any(fates.values())
            assert writer.reliable
            continue
        seen = range(heard[0], heard[-1] + 1) if end == "receiver" else range(written)
        assert writer.written == len(seen)
        assert fates["missing"] == (len(seen) - len(heard) if end == "receiver" else 0)
        assert not writer.reliable
    twists = found["/cmd_vel"]
    assert twists.asked_for == twists.resent > 10
    # At the sender's end all had been captured before a reader asked; at the receiver's none had.
    assert twists.behind == (twists.resent if end == "sender" else 0)
    assert (twists.copies > 0) == (end == "sender")


def test_info_counts_each_sample_once():
    path = next(item for item in CAPTURES if item.name.startswith("cyclone_sender"))
    source = open_files([path])
    found = inspect(source, Settings().workbench(source.info)).summary()
    rows = {row["topic"]: row for row in found["samples"]}
    assert {topic: row["count"] for topic, row in rows.items()} == TRUTH["cyclone"]["written"]
    assert {row["missing"] for row in rows.values()} == {0}
    assert rows["/cmd_vel"]["type"] == "geometry_msgs/msg/Twist"
    assert rows["/cmd_vel"]["copies"] == 12


def test_what_is_beside_dds_is_judged_as_before():
    rover, config = ROOT / "samples/captures/a_rover.pcap", ROOT / "samples/missions/rover_ground.yaml"
    dds = next(item for item in CAPTURES if item.name.startswith("cyclone_receiver"))

    def judged(*paths):
        source = open_files(paths)
        return examine(source, Settings([config]).workbench(source.info)).summary()

    alone, beside = judged(rover), judged(rover, dds)
    check(beside | {"schema": 1}, published("doctor"))
    own = {"dds_lost", "dds_resent"}
    assert alone["routes"] == beside["routes"]
    assert alone["balance"] == [row for row in beside["balance"] if row["link"] != "rtps"]
    assert alone["verdicts"] == [item for item in beside["verdicts"] if item["rule"] not in own]
    assert {item["rule"] for item in beside["verdicts"]} >= own
    assert beside["examined"] - alone["examined"] == 298


def follow(follower, *payloads, size=3):
    decoder = ColumnDecoder(Context())
    for at in range(0, len(payloads), size):
        batch = batch_of(*payloads[at : at + size], number=at + 1)
        follower.add(batch, decoder.decode(batch))
    return follower


NUMBER = st.integers(1, 12)
BITS = st.integers(0, (1 << 12) - 1)
EVENT = st.one_of(
    st.tuples(st.just("data"), NUMBER),
    st.tuples(st.just("beat"), NUMBER, NUMBER),
    st.tuples(st.just("gap"), NUMBER, NUMBER),
    st.tuples(st.just("ack"), NUMBER, BITS),
)


def payload(event):
    kind, first, *rest = event
    if kind == "data":
        return message(data(first, b"\0\1\0\0"))
    if kind == "beat":
        return message(made(SubmessageKind.HEARTBEAT, first=first, last=rest[0], count=1))
    tail = (rest[0] << 20).to_bytes(4, "little") if kind == "ack" else b""
    if kind == "gap":
        return message(made(SubmessageKind.GAP, gap_start=first, base=rest[0], num_bits=0))
    to = made(SubmessageKind.INFO_DST, guid_prefix=PREFIX)
    return message(to, made(SubmessageKind.ACKNACK, tail=tail, base=first, num_bits=12), prefix=OTHER)


@settings(max_examples=examples(400), deadline=None)
@given(st.lists(EVENT, max_size=25), st.integers(1, 6))
def test_any_order_adds_up(events, size):
    follower = follow(SampleFollower(Endpoints()), *map(payload, events), size=size)
    numbers = [event[1] for event in events if event[0] == "data"]
    if not numbers:
        return
    writer = follower.writers[PREFIX + WRITER]
    fates = writer.fates()
    assert min(fates.values()) >= 0
    assert writer.captured == len({number for number in numbers if number >= numbers[0]})
    assert writer.copies == len(numbers) - len(set(numbers))
    assert writer.written == writer.captured + sum(fates.values()) - fates["lost_behind"]
    assert fates["lost_behind"] <= writer.captured
    assert 0 <= writer.behind <= writer.requested.size
    # The size of batches changes nothing that does not depend on what was captured later in them.
    other = follow(SampleFollower(Endpoints()), *map(payload, events), size=len(events)).writers[
        PREFIX + WRITER
    ]
    assert (other.written, other.captured, other.copies) == (writer.written, writer.captured, writer.copies)


@pytest.mark.long
def test_more_holes_than_are_kept_are_all_counted():
    numbers = np.arange(1, 60_001)
    kept = numbers[(numbers * 7919 % 10 < 6) | (numbers == 1)].tolist()
    payloads = [
        message(*(data(number, b"") for number in kept[at : at + 500])) for at in range(0, len(kept), 500)
    ]
    (writer,) = follow(SampleFollower(Endpoints()), *payloads, payloads[0], size=30).writers.values()
    assert writer.sample_numbers.count < MOST_RANGES
    assert writer.captured == len(kept)
    assert writer.written == kept[-1]
    assert writer.fates()["missing"] == kept[-1] - len(kept)
    assert writer.copies == 500


@pytest.mark.long
def test_numbers_that_cannot_be_and_floods_are_bounded():
    huge = message(data((1 << 63) - 1, b"\0\1\0\0"))
    far = message(made(SubmessageKind.HEARTBEAT, first=1, last=1 << 50, count=1))
    follower = follow(SampleFollower(Endpoints()), message(data(5, b"\0\1\0\0")), huge, far)
    (writer,) = follower.writers.values()
    assert (writer.first, writer.last, writer.written) == (5, 5, 1)
    last = 300_000
    beat = message(made(SubmessageKind.HEARTBEAT, first=1, last=last, count=1))
    asks = [
        message(
            made(SubmessageKind.INFO_DST, guid_prefix=PREFIX),
            made(SubmessageKind.ACKNACK, tail=b"\xff" * 32, base=base, num_bits=256),
            prefix=OTHER,
        )
        for base in np.linspace(6, last - 300, 100).astype(int).tolist()
    ]
    follow(follower, beat, *asks, size=200)
    assert 0 < len(writer.open) <= MOST_ASKED
    assert writer.written == last - 4
