"""Whatever the network and the capture do to TCP segments, the messages are those of the clean stream."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import ACK, CLIENT, FIN, SERVER, SYN, Segment, frames, sbn_message, sbn_messages, segments_of

from edoras_tools.io.frames import tcp
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Finding

MESSAGES = sbn_messages(40)
STREAM = b"".join(MESSAGES)
SIX = {"source": ("fd00::1", 40000), "destination": ("fd00::2", 2234)}
PART, GAP, AGAIN = Finding.FRAGMENT, Finding.STREAM_GAP, Finding.STREAM_RESENT


def read(*batches, finish=True):
    """Return all rows, of the batches one after the other."""
    demux = Demux()
    found, number = [], 1
    for segments in batches:
        found.append(demux.demux(frames(segments, number)))
        number += len(segments)
    rest = demux.finish() if finish else None
    found += [rest] if rest is not None else []
    return [batch[row] for batch in found for row in range(len(batch))]


def messages(rows):
    return [item.payload for item in rows if PART not in item.findings]


def kinds(rows):
    return [item.findings for item in rows]


cuts = st.lists(st.integers(1, len(STREAM) - 1), max_size=30)


@given(cuts, st.sampled_from([{}, SIX]), st.integers(0, (1 << 32) - 1))
def test_messages_do_not_depend_on_where_segments_end(where, ends, begin):
    rows = read(segments_of(STREAM, where, begin, **ends))
    assert messages(rows) == MESSAGES
    assert not any(kinds(rows))
    assert all(item.stream for item in rows)


@given(cuts, st.data())
def test_order_repetition_overlap_and_batches_change_nothing(where, data):
    first, *rest = segments_of(STREAM, where, (1 << 32) - 700)
    wild = data.draw(st.permutations(rest))
    for at in data.draw(st.lists(st.integers(0, len(STREAM) - 2), max_size=5)):
        size = data.draw(st.integers(2, 400))
        again = Segment((1 << 32) - 700 + at, STREAM[at : at + size])
        wild.insert(data.draw(st.integers(0, len(wild))), again)
    split = data.draw(st.integers(0, len(wild)))
    rows = read([first, *wild[:split]], wild[split:])
    assert messages(rows) == MESSAGES
    assert not any(GAP in item.findings for item in rows)


@given(st.lists(st.integers(0, 39), min_size=1, max_size=6, unique=True), st.booleans())
def test_what_the_capture_lost_is_a_gap_and_nothing_else_is_lost(lost, acknowledged):
    edges = np.cumsum([len(item) for item in MESSAGES])
    segments = segments_of(STREAM, edges.tolist())
    sent = [item for place, item in enumerate(segments[1:]) if place not in lost]
    if acknowledged:
        sent.append(Segment(5, b"", ACK, 1000 + len(STREAM), SERVER, CLIENT))
    rows = read([segments[0], *sent])
    assert messages(rows) == [item for place, item in enumerate(MESSAGES) if place not in lost]
    behind = {place for place in range(40) if place not in lost and (place - 1) in lost}
    marked = [GAP in item.findings for item in rows]
    assert sum(marked) == len(behind)


def test_a_gap_in_a_message_leaves_its_rest_as_a_part_with_its_bytes():
    begin = len(MESSAGES[0] + MESSAGES[1])
    third = begin + len(MESSAGES[2])
    segments = segments_of(STREAM, [begin + 5, begin + 15, third])
    rows = read([segments[0], segments[1], *segments[3:]])
    assert messages(rows) == MESSAGES[:2] + MESSAGES[3:]
    parts = [item for item in rows if PART in item.findings]
    assert [item.frame[54:] for item in parts] == [STREAM[begin : begin + 5], STREAM[begin + 15 : third]]
    assert all(kind == PART | GAP for kind in kinds(parts))


def test_a_missing_segment_is_waited_for_until_it_is_acknowledged():
    one, two, three = (segments_of(STREAM, [30, 60])[at] for at in (1, 2, 3))
    demux = Demux()
    opening = segments_of(STREAM, [])[0]
    waited = demux.demux(frames([opening, one, three]))
    assert len(waited) == len([at for at in np.cumsum([len(item) for item in MESSAGES]) if at <= 30])
    rest = demux.demux(frames([two], 4))
    assert len(waited) + len(rest) == len(MESSAGES)
    assert not rest.capture_findings.any()
    assert demux.finish() is None

    demux = Demux()
    demux.demux(frames([opening, one, three]))
    answer = Segment(5, b"", ACK, 1000 + len(STREAM), SERVER, CLIENT)
    soon = demux.demux(frames([answer], 4))
    assert not len(soon)
    told = demux.demux(frames([answer], 60))
    assert [item for item in told.capture_findings if item & GAP]


def test_a_missing_segment_is_waited_for_a_second_at_most():
    one, _, three = (segments_of(STREAM, [30, 60])[at] for at in (1, 2, 3))
    later = Segment(9, sbn_message(0xA0, b""), source=("10.0.0.9", 5), time_ns=1_700_000_002_000_000_000)
    rows = read([segments_of(STREAM, [])[0], one, three, later], finish=False)
    assert any(GAP in item.findings for item in rows)


@pytest.mark.parametrize("start", range(0, 60, 7))
def test_a_capture_that_begins_inside_a_message_finds_the_next_one(start):
    edges = np.cumsum([len(item) for item in MESSAGES]).tolist()
    rows = read(segments_of(STREAM[start:], [len(STREAM) // 2])[1:])
    first = next(place for place, at in enumerate([0, *edges]) if at >= start)
    assert messages(rows) == MESSAGES[first:]
    assert (PART in rows[0].findings) == (start not in {0, *edges})


def test_segments_that_come_again_are_rows_of_their_own():
    segments = segments_of(STREAM, [100, 200])
    rows = read([*segments[:3], segments[2], segments[3], segments[1]])
    assert messages(rows) == MESSAGES
    again = [item for item in rows if AGAIN in item.findings]
    assert [item.number for item in again] == [4, 6]
    assert [item.frame for item in again] == [segments[2].frame(), segments[1].frame()]


def test_a_byte_that_keeps_the_connection_alive_is_not_one_that_was_sent_again():
    segments = segments_of(STREAM, [])
    rows = read([*segments, Segment(1000 + len(STREAM) - 1, STREAM[-1:])])
    assert messages(rows) == MESSAGES
    assert not any(kinds(rows))


def test_a_message_alone_in_its_segment_keeps_its_frame_and_others_get_one():
    edges = np.cumsum([len(item) for item in MESSAGES]).tolist()
    segments = segments_of(STREAM, edges)
    assert [item.frame for item in read(segments)] == [item.frame() for item in segments[1:]]
    made = [item.frame for item in read(segments_of(STREAM, [7, 300]))]
    for frame, segment in zip(made, segments[1:], strict=True):
        assert frame == segment.frame()


@given(cuts, st.sampled_from([{}, SIX]))
def test_the_rows_frames_are_a_capture_of_the_same_stream(where, ends):
    rows = read(segments_of(STREAM, where, **ends))
    again = [item.frame for item in rows]
    other = [item.frame() for item in segments_of(STREAM, np.cumsum([len(m) for m in MESSAGES]), **ends)[1:]]
    assert again == other


def test_time_and_number_are_those_of_the_segment_that_completes_the_message():
    segments = segments_of(STREAM, [5, len(MESSAGES[0]) + 3])
    rows = read([segments[0], segments[2], segments[1], segments[3]])
    assert rows[0].number == 3
    assert {item.number for item in rows[1:]} == {4}


def test_many_connections_are_kept_apart():
    streams = [
        segments_of(b"".join(sbn_messages(5, size)), [10, 40], size, source=("10.0.0.1", 50000 + size))
        for size in range(60)
    ]
    rows = read([item for group in zip(*streams, strict=True) for item in group])
    for size in range(60):
        mine = [item.payload for item in rows if item.source.port == 50000 + size]
        assert mine == sbn_messages(5, size)


def test_the_same_ports_again_are_another_connection():
    first, second = segments_of(STREAM, [50], 10), segments_of(STREAM, [60], 5_000_000)
    cut = [*first[:2], Segment(60, b"", ACK | FIN), *second]
    rows = read(cut)
    assert messages(rows)[-40:] == MESSAGES
    assert read([*first, *segments_of(STREAM, [80], 3_000_000_000)[1:]])[-1].payload == MESSAGES[-1]


def test_a_segment_that_the_capture_cut_has_no_bytes_that_are_not_there():
    edges = np.cumsum([len(item) for item in MESSAGES]).tolist()
    segments = segments_of(STREAM, edges)
    segments[3] = segments[3]._replace(captured=60)
    rows = read(segments)
    assert messages(rows) == MESSAGES[:2] + MESSAGES[3:]
    cut = [item for item in rows if Finding.CAPTURE_CUT in item.findings]
    assert [item.frame for item in cut] == [segments[3].frame()[:60]]


@pytest.mark.quick("data3")
@pytest.mark.parametrize(
    "data", [b"\xff" * 5000, bytes(5000), b"GET / HTTP/1.1\r\n" * 300, b"\x7f\xff\x03" * 900]
)
def test_another_protocol_on_the_port_is_kept_as_parts(data):
    rows = read(segments_of(data, range(0, len(data), 700)))
    kept = b"".join(item.frame[54:] for item in rows)
    assert kept == data
    demux = Demux()
    for at in range(60):
        chunk = Segment(at * len(data), data)
        demux.demux(frames([chunk], at + 1))
    waiting = demux.finish()
    assert waiting is None or len(waiting.data) < 200_000


@given(st.lists(st.tuples(st.integers(0, 3000), st.binary(max_size=300), st.integers(0, 31)), max_size=20))
def test_nothing_in_a_stream_makes_it_fail(pieces):
    segments = [Segment(at, data, flags) for at, data, flags in pieces]
    rows = read(segments[:9], segments[9:])
    assert all(item.stream for item in rows)


@given(st.binary(max_size=120))
def test_nothing_in_a_header_makes_it_fail(junk):
    frame = Segment(1, STREAM).frame()[:34] + b"\x00\x01\x08\xba" + junk
    batch = frames([Segment(1, STREAM)])
    raw = np.frombuffer(frame, np.uint8)
    size = np.array([len(frame)], np.int32)
    demux = Demux()
    demux.demux(type(batch)(raw, batch.number, batch.time_ns, batch.link_type, batch.offset, size, size))
    demux.finish()


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr("edoras_tools.io.frames.linklayer._WAITING_BYTES", 100_000)
    monkeypatch.setattr(tcp, "CONNECTIONS", 25)
    demux = Demux()
    largest = 0
    for at in range(60):  # each of another connection, each behind a gap, at one time
        source = ("10.0.0.1", 1000 + at)
        opening, data = Segment(1, flags=SYN, source=source), Segment(900, bytes(5000), source=source)
        demux.demux(frames([opening, data]))
        largest = max(largest, demux._waiting.data.size if demux._waiting is not None else 0)
    assert 50_000 < largest < 120_000
    assert len(demux._streams._directions) <= 25


def test_other_tcp_and_segments_without_bytes_are_skipped():
    demux = Demux()
    other = Segment(1, b"x" * 50, destination=("10.0.0.2", 443))
    batch = demux.demux(frames([other, *segments_of(STREAM, []), Segment(5, b"", ACK, 3000, SERVER, CLIENT)]))
    assert len(batch) == len(MESSAGES)
    assert demux.skipped == 3


def test_a_port_can_be_named_and_the_usual_ones_left_out():
    demux = Demux()
    demux.framings = {9999: Demux().framings[2234]}
    batch = demux.demux(frames(segments_of(STREAM, [], destination=("10.0.0.2", 9999))))
    assert len(batch) == len(MESSAGES)
    assert len(demux.demux(frames(segments_of(STREAM, [])))) == 0
