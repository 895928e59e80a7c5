"""The parts that verdicts rest on: fingerprints, counts, counters, spans, matching, budgets."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.accounting.budget import limit, predict
from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.diagnosis.evidence.loss_reports import Track, _returns, parse_loss_event
from edoras_tools.diagnosis.evidence.payloads import EventRecord
from edoras_tools.diagnosis.matching.streams import comb, find_streams
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.model import Finding
from edoras_tools.ros import TypeStore
from edoras_tools.units import MILLISECOND, SECOND

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


def test_the_latest_equal_one_that_is_not_later():
    into, into_ns = np.array([7, 8, 7, 9], np.uint64), np.array([1, 2, 3, 9])
    out, out_ns = np.array([7, 7, 9, 0], np.uint64), np.array([2, 5, 5, 9])
    assert fingerprint.latest_equal(into, into_ns, out, out_ns).tolist() == [0, 2, -1, -1]


@pytest.mark.parametrize(("link", "between"), [(TO, 2), (SBN, 0)])
def test_what_is_missing_lies_between_a_row_and_its_next(link, between):
    """Of a stream with a pause, with a count from before its first row, and with bytes that TCP delivered."""
    size = 10
    times = np.array([0, 1, 2, 3, 4, 30, 31, 32, 33, 34]) * SECOND
    missing = np.array([3, 0, 2, 0, 0, 19, 0, 0, 0, 0], np.int32)
    zeros = np.zeros(size, np.int32)
    rows = SimpleNamespace(
        time_ns=times,
        link=np.full(size, link, np.uint8),
        msg_id=np.full(size, 0x827, np.int32),
        known_id=np.full(size, 0x827, np.int32),
        route=zeros - 1,
        counted=np.ones(size, bool),
        missing=missing,
        has=lambda finding: (np.arange(size) == 2) & (finding == Finding.STREAM_GAP),
        on=lambda accepts, rows=slice(None): np.full(size, accepts(link))[rows],
        **dict.fromkeys(("source", "destination", "processor_id", "spacecraft_id"), zeros),
        **dict.fromkeys(("duplicates", "reordered", "restarts"), zeros + 1),
    )
    (stream,) = find_streams(rows, SimpleNamespace(of_row=zeros, output=lambda source: source))
    assert stream.missing.tolist() == [0, between, 0, 0, 19, 0, 0, 0, 0, 0]
    assert np.flatnonzero(stream.pauses).tolist() == [4]
    assert (stream.gaps, stream.duplicates, stream.reordered, stream.restarts) == (24, 10, 10, 9)


def track(*values, name="msg_limits", restarted=()):
    steps = np.isin(np.arange(len(values) - 1), restarted)
    return Track(np.arange(len(values)) * SECOND, {name: np.array(values)}, steps)


@pytest.mark.parametrize(
    ("values", "growth", "set_back"),
    [
        ((4, 4, 9), 5, []),
        ((65530, 65535, 3), 9, []),
        ((100, 120, 0, 2), 22, [1]),
        ((7,), 0, []),
    ],
)
def test_counters_wrap_and_are_set_back(values, growth, set_back):
    told = track(*values)
    assert (told.growth("msg_limits"), told.set_back) == (growth, set_back)
    assert told.older["msg_limits"] == values[0]


def test_behind_a_restart_a_counter_has_grown_from_0_also_where_it_did_not_fall():
    told = track(0, 10, 15, 16, restarted=[1])
    assert (told.growth("msg_limits"), told.set_back) == (10 + 15 + 1, [1])


def test_of_samples_that_are_close_together_the_last_is_enough():
    made_ns = np.array([0, 1, 40, 90, 100, 150, 330]) * MILLISECOND
    counts = np.array([3, 4, 9, 0, 1, 2, 7])
    history = Track(made_ns, {"msg_limits": counts}, np.zeros(6, bool))
    assert history.times == [0, 90 * MILLISECOND, 150 * MILLISECOND, 330 * MILLISECOND]
    assert history.totals["msg_limits"] == [0, 6, 8, 13]
    assert history.set_back == [0]


@pytest.mark.parametrize(
    ("limits", "no_subscribers", "returns"),
    [
        ((2, 8, 8), (13, 13, 14), False),
        ((38, 0, 3, 40), (13, 0, 0, 1), False),
        ((38, 0, 39, 0, 39), (13, 0, 14, 0, 14), True),
        ((85, 131, 85, 131), (13, 65, 13, 65), True),
        ((85, 85, 85), (13, 250, 4), False),
    ],
)
def test_counters_that_fall_and_come_back_at_once_are_of_two_instances(limits, no_subscribers, returns):
    assert _returns(np.array([np.zeros_like(limits), limits, no_subscribers, limits])) == returns


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
    reported = parse_loss_event(EventRecord(0, 1, 0, app, number, 3, "66:1", message))
    assert (reported.kind, reported.msg_id, reported.pipe, reported.sender) == want


@given(st.sampled_from([14, 15, 17, 21, 25]), st.text(max_size=80))
def test_any_other_text_names_nobody(number, text):
    reported = parse_loss_event(EventRecord(0, 1, 0, "CFE_SB", number, 3, "66:1", text))
    assert reported is None or reported.msg_id >= 0


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
        (CI, 0x1827, True, 8.0),
        (TO, 0x827, False, 8.0),
        (SBN, 0x82A, False, 40.0),
        (SBN, 0x1829, True, 0.0),
    ],
)
def test_budgets_follow_from_the_constants(link, msg_id, to_cfs, hertz):
    assert limit(link, msg_id, SimProfile(), to_cfs=to_cfs)[0] == hertz


def test_a_high_table_limit_leaves_the_pipe_as_the_limit():
    found = limit(TO, 0x827, SimProfile(to_limits={0x827: 255}), to_cfs=False)
    assert (found.hz, found.hop) == (90.0, "TO_LAB_TLM_PIPE")
    assert "beside housekeeping" in found.reason


def test_sizes_and_their_traps_are_predicted(tmp_path, lab):
    mission = load(lab.mission("two_rovers_flight"), check_type=TYPES.check)
    by_id = {item.route.msg_id: item for item in predict(mission, TYPES, SimProfile())}
    assert by_id[0x82A].bytes == 11 + 16 + 16 + 52
    assert by_id[0x1829].bytes is None
    assert not by_id[0x82A].traps
