"""The parts that verdicts rest on: fingerprints, counts, counters, spans, matching, budgets."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.diagnosis import fingerprint
from edoras_tools.diagnosis.budget import limit, predict
from edoras_tools.diagnosis.counters import Track
from edoras_tools.diagnosis.events import parse
from edoras_tools.diagnosis.payloads import EventRecord, Housekeeping
from edoras_tools.diagnosis.spans import comb
from edoras_tools.diagnosis.streams import find_streams
from edoras_tools.mission import load
from edoras_tools.model import Link
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.profile import MILLISECOND, SECOND, SimProfile

TYPES = TypeStore()
POSE = "geometry_msgs/msg/PoseStamped"


def stamped(seconds, x, frame="map"):
    header = {"stamp": {"sec": seconds, "nanosec": 5}, "frame_id": frame}
    return {"header": header, "pose": {"position": {"x": x}}}


def prints(*messages):
    data = np.frombuffer(b"".join(messages), np.uint8)
    length = np.array([len(item) for item in messages], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    return fingerprint.of_values(TYPES, POSE, data, offset, length)


def test_values_and_not_bytes_make_a_fingerprint():
    little = TYPES.encode(POSE, stamped(1, 2.5))
    big = TYPES.encode(POSE, stamped(1, 2.5), big_endian=True)
    later = TYPES.encode(POSE, stamped(9, 2.5))
    other = TYPES.encode(POSE, stamped(1, 2.6))
    plain, with_stamp = prints(little, big, later, other)
    assert plain[0] == plain[1] == plain[2] != plain[3]
    assert with_stamp[0] == with_stamp[1] != with_stamp[2]
    assert 0 not in plain


def test_a_message_that_does_not_decode_has_no_fingerprint():
    plain, with_stamp = prints(b"\0\1\0\0" + bytes(3), TYPES.encode(POSE, stamped(1, 1.0)))
    assert plain[0] == with_stamp[0] == 0
    assert plain[1]


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=12))
def test_equal_bytes_and_only_those_share_a_fingerprint(messages):
    data = np.frombuffer(b"".join(messages), np.uint8)
    length = np.array([len(item) for item in messages], np.int32)
    found = fingerprint.of_bytes(data, np.cumsum(length, dtype=np.int64) - length, length)
    for index, one in enumerate(messages):
        for other, two in enumerate(messages):
            assert (found[index] == found[other]) == (one == two)


def test_the_latest_equal_one_that_is_not_later():
    into, into_ns = np.array([7, 8, 7, 9], np.uint64), np.array([1, 2, 3, 9])
    out, out_ns = np.array([7, 7, 9, 0], np.uint64), np.array([2, 5, 5, 9])
    assert fingerprint.latest_equal(into, into_ns, out, out_ns).tolist() == [0, 2, -1, -1]


def rows_of(counts, *, link=Link.TO, times=None, prints_=None):
    """Return a table of one stream with these counts; None is a sequence word of 0."""
    size = len(counts)
    column = {
        "time_ns": np.array(times if times is not None else np.arange(size) * SECOND, np.int64),
        "link": np.full(size, link, np.uint8),
        "sequence_count": np.array([count or 0 for count in counts], np.uint16),
        "msg_id": np.full(size, 0x827, np.int32),
        "packet_print": np.array(prints_ or range(1, size + 1), np.uint64),
        "route": np.full(size, -1, np.int16),
    }
    zeros = np.zeros(size, np.int32)
    unset = np.array([count is None for count in counts])
    return SimpleNamespace(
        **column,
        source=zeros,
        destination=zeros,
        processor_id=zeros,
        spacecraft_id=zeros,
        has=lambda _: unset,
        __len__=lambda: size,
    )


def only_stream(counts, **more):
    rows = rows_of(counts, **more)
    instances = SimpleNamespace(of_row=np.zeros(len(counts), np.int32))
    (stream,) = find_streams(rows, instances)
    return stream


@pytest.mark.parametrize(
    ("counts", "gaps", "duplicates", "reordered", "restarts"),
    [
        ([1, 2, 3, 4], 0, 0, 0, 0),
        ([1, 2, 5, 6], 2, 0, 0, 0),
        ([16382, 16383, 0, 1, 2], 0, 0, 0, 0),
        ([16380, 2, 3], 5, 0, 0, 0),
        ([1, 2, 4, 3, 5], 0, 0, 1, 0),
        ([500, 501, 502, 1, 2, 3], 0, 0, 0, 1),
        ([500, 501, 502, 1, 2, 5], 2, 0, 0, 1),
        ([9, 9, 9, 9, 9], 0, 0, 0, 0),
        ([None, None, None], 0, 0, 0, 0),
        ([3, 90, 12, 8000, 44, 3000, 7, 1234], 0, 0, 0, 0),
    ],
)
def test_counts_are_followed(counts, gaps, duplicates, reordered, restarts):
    stream = only_stream(counts)
    assert (stream.gaps, stream.duplicates, stream.reordered, stream.restarts) == (
        gaps,
        duplicates,
        reordered,
        restarts,
    )


def test_the_same_packet_again_is_a_duplicate():
    stream = only_stream([1, 2, 2, 3], prints_=[11, 12, 12, 13])
    assert (stream.duplicates, stream.gaps, stream.restarts) == (1, 0, 0)


def test_what_is_missing_behind_a_pause_is_told_apart():
    times = [0, 1, 2, 3, 4, 30, 31, 32, 33, 34]
    stream = only_stream([1, 2, 3, 4, 5, 25, 26, 27, 28, 29], times=[t * SECOND for t in times])
    assert stream.gaps == 0
    assert int(stream.missing.sum()) == 19


@given(st.lists(st.integers(0, 16383), min_size=1, max_size=60))
def test_no_count_makes_more_gaps_than_its_range(counts):
    stream = only_stream(counts)
    assert 0 <= stream.gaps < 16384 * len(counts)


def track(*values, name="msg_limits"):
    told, last = Track(), None
    for at, value in enumerate(values):
        numbers = dict.fromkeys(("pipe_overflows", "msg_limits", "no_subscribers", "send_errors"), 0)
        sample = Housekeeping(row=at, time_ns=0, **{**numbers, name: value})
        told.add(at * SECOND, sample, last)
        last = sample
    return told


@pytest.mark.parametrize(
    ("values", "growth", "resets"),
    [
        ((4, 4, 9), 5, 0),
        ((65530, 65535, 3), 9, 0),
        ((100, 120, 0, 2), 22, 1),
        ((7,), 0, 0),
    ],
)
def test_counters_wrap_and_are_reset(values, growth, resets):
    told = track(*values)
    assert (told.growth("msg_limits"), told.resets) == (growth, resets)
    assert told.older["msg_limits"] == values[0]


def test_growth_takes_the_samples_around_a_time():
    told = track(0, 1, 2, 4, 8)
    assert told.growth("msg_limits", int(1.5 * SECOND), int(2.5 * SECOND)) == 3


@pytest.mark.parametrize(
    ("app", "number", "message", "want"),
    [
        (
            "CFE_SB",
            17,
            "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP",
            ("limit", 0x1827, "EDORAS_APP_PIPE", "CI_LAB_APP"),
        ),
        (
            "CFE_SB",
            25,
            "Pipe Overflow,MsgId 0x8f1,pipe TO_LAB_TLM_PIPE,sender EDORAS_GEN.EDORAS_GEN_T",
            ("overflow", 0x8F1, "TO_LAB_TLM_PIPE", "EDORAS_GEN.EDORAS_GEN_T"),
        ),
        (
            "CFE_SB",
            14,
            "No subscribers for MsgId 0x18ee,sender CI_LAB_APP",
            ("no_subscriber", 0x18EE, "", "CI_LAB_APP"),
        ),
        (
            "CFE_SB",
            21,
            "Send Err:Invalid MsgId(0x2827)in msg,App CI_LAB_APP",
            ("invalid", 0x2827, "", "CI_LAB_APP"),
        ),
        (
            "CFE_SB",
            15,
            "Send Err:Msg Too Big MsgId=0x1827,app=CI_LAB_APP,size=65542,MaxSz=32768",
            ("too_big", 0x1827, "", "CI_LAB_APP"),
        ),
    ],
)
def test_events_about_loss_are_read_word_for_word(app, number, message, want):
    culprit = parse(EventRecord(0, 1, 0, app, number, 3, "66:1", message))
    assert (culprit.kind, culprit.msg_id, culprit.pipe, culprit.sender) == want


@given(st.sampled_from([14, 15, 17, 21, 25]), st.text(max_size=80))
def test_any_other_text_names_nobody(number, text):
    culprit = parse(EventRecord(0, 1, 0, "CFE_SB", number, 3, "66:1", text))
    assert culprit is None or culprit.msg_id >= 0


def test_rounds_are_found():
    times = np.array(
        [round_ * 500 * MILLISECOND + at * MILLISECOND for round_ in range(20) for at in range(4)]
    )
    found = comb(times)
    assert (found.period_ns, found.most, found.share) == (500 * MILLISECOND, 4, 1.0)


def test_an_even_stream_comes_in_no_rounds():
    assert comb(np.arange(40) * 100 * MILLISECOND).most == 1


@pytest.mark.parametrize(
    ("link", "msg_id", "to_cfs", "hertz"),
    [
        (Link.CI, 0x1827, True, 8.0),
        (Link.TO, 0x827, False, 8.0),
        (Link.SBN, 0x82A, False, 40.0),
        (Link.SBN, 0x1829, True, 0.0),
    ],
)
def test_budgets_follow_from_the_constants(link, msg_id, to_cfs, hertz):
    assert limit(link, msg_id, SimProfile(), to_cfs=to_cfs)[0] == hertz


def test_a_high_table_limit_leaves_the_pipe_as_the_limit():
    hertz, hop, reason = limit(Link.TO, 0x827, SimProfile(to_limits={0x827: 255}), to_cfs=False)
    assert (hertz, hop) == (90.0, "TO_LAB_TLM_PIPE")
    assert "beside housekeeping" in reason


def test_sizes_and_their_traps_are_predicted(tmp_path, lab):
    mission = load(lab.mission("two_rovers_flight"), check_type=TYPES.check)
    by_id = {item.route.msg_id: item for item in predict(mission, TYPES, SimProfile())}
    assert by_id[0x82A].bytes == 11 + 16 + 16 + 52
    assert by_id[0x1829].bytes is None
    assert not by_id[0x82A].traps
