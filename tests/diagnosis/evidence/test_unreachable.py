"""Closed ports: what ICMP errors prove, on made-up traffic of known truth and on a real capture, changed."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from icmp_errors import error_about
from mutations import Frame, frames, write
from scapy.layers.inet import IP
from truth import FOLDER, diagnosed, sums

from edoras_tools.diagnosis.evidence.port_errors import PortErrors
from edoras_tools.diagnosis.evidence.table import Rows
from edoras_tools.diagnosis.evidence.unreachable import Unreachable
from edoras_tools.links.bare import ROBOT as ROBOT_LINK
from edoras_tools.model import Endpoint

SECOND, MS = 10**9, 10**6
ENDS = [Endpoint("10.0.0.1", 8080), Endpoint("10.0.0.2", 8585), Endpoint("10.0.0.2", 1235)]
LOOP = [Endpoint("127.0.0.1", item.port) for item in ENDS]
SENDER, ROBOT, BRIDGE = range(3)
HALF = 40
HOST_UNREACHABLE = 0x040301


class Errors:
    """What a recorder of errors gives: (time, receiver, identification, closed), and who spoke when."""

    def __init__(self, errors, voices=(), reason=HOST_UNREACHABLE):
        columns = [np.array([item[at] for item in sorted(errors)], np.int64) for at in range(4)]
        time_ns, receiver, identification, closed = columns
        source = np.full(len(errors), SENDER)
        reason = np.full(len(errors), reason)
        own = np.arange(len(errors))
        rest = closed.astype(bool), reason, own, own
        self.all = PortErrors(time_ns, source, receiver, identification, *rest)
        self.spoke = np.array(voices, np.int64), np.full(len(voices), ROBOT)

    def errors(self):
        return self.all

    def voices(self):
        return self.spoke


def rows_of(sent):
    """Return rows of (time, receiver, identification)."""
    columns = [np.array([item[at] for item in sent], np.int64) for at in range(3)]
    return Rows.of_messages(
        time_ns=columns[0],
        source=np.full(len(sent), SENDER, np.int32),
        destination=columns[1].astype(np.int32),
        identification=columns[2].astype(np.uint16),
    )


def found_in(sent, errors, voices=(), ends=LOOP, reason=HOST_UNREACHABLE):
    return Unreachable(rows_of(sent), Errors(errors, voices, reason), ends, {})


def every(step_ms, count, receiver=ROBOT, number=1):
    return [(at * step_ms * MS, receiver, number + at) for at in range(count)]


def about(item, after=20_000, closed=1):
    return item[0] + after, item[1], item[2], closed


def test_a_port_is_closed_from_the_first_error_to_the_next_sign_of_life():
    sent = every(200, 100)
    away = sent[30:60]
    found = found_in(sent, [about(item) for item in away])
    assert np.flatnonzero(found.closed).tolist() == list(range(30, 60))
    assert not found.uncertain.any()
    assert not found.refused.any()
    (span,) = found.spans
    assert (span.start_ns, span.last_ns) == (away[0][0], away[-1][0])
    assert (span.end_ns, span.errors, str(span.port)) == (sent[60][0], 30, "127.0.0.1:8585")


def test_what_came_after_the_last_own_datagram_of_a_port_may_not_have_been_read():
    sent = every(200, 100)
    voices = [at * 500 * MS for at in range(12)] + [sent[60][0] - 50 * MS]
    found = found_in(sent, [about(item) for item in sent[30:60]], voices)
    (span,) = found.spans
    assert (span.step_ns, span.end_ns) == (500 * MS, voices[-1])
    assert np.flatnonzero(found.uncertain).tolist() == [28, 29]  # behind 5.5 s
    assert int(found.closed.sum()) == 30


def test_one_datagram_without_an_error_may_have_lost_it():
    sent = every(200, 100)
    found = found_in(sent, [about(item) for item in sent[30:60] if item != sent[40]])
    assert len(found.spans) == 1
    assert np.flatnonzero(found.uncertain).tolist() == [40]
    assert int(found.closed.sum()) == 29


def test_two_without_an_error_show_that_it_is_open():
    sent = every(200, 100)
    gone = sent[30:40] + sent[42:60]
    found = found_in(sent, [about(item) for item in gone])
    assert [span.errors for span in found.spans] == [10, 18]
    assert int(found.closed.sum()) == 28
    assert not found.uncertain.any()


def test_errors_that_are_one_a_second_leave_no_loss_out():
    """Of 5 a second each second has an error; what comes behind the last one may be lost."""
    sent = every(200, 100)
    found = found_in(sent, [about(item) for item in sent[30:60:5]], ends=ENDS)
    (span,) = found.spans
    assert np.flatnonzero(found.closed).tolist() == list(range(30, 56))
    assert span.end_ns == sent[61][0]  # 1.2 s behind the last error: one was due
    assert np.flatnonzero(found.uncertain).tolist() == [56, 57, 58, 59, 60]


def test_a_port_that_speaks_and_hears_nobody_is_closed():
    """A socket that is connected to another one takes datagrams of that one alone."""
    sent = every(200, 100)
    voices = [at * 100 * MS + 1 for at in range(200)]
    found = found_in(sent, [about(item) for item in sent[30:60]], voices)
    (span,) = found.spans
    assert (span.errors, span.step_ns) == (30, 0)
    assert np.flatnonzero(found.closed).tolist() == list(range(30, 60))
    assert not found.uncertain.any()


@pytest.mark.parametrize("ends", [LOOP, ENDS])
def test_an_error_without_its_datagram_proves_nothing_of_others(ends):
    """The capture is on another side: the errors pass here, the datagrams do not."""
    sent = every(200, 50, BRIDGE)
    errors = [(at * 200 * MS + 1000, ROBOT, 7000 + at, 1) for at in range(50)]
    found = found_in(sent, errors, ends=ends)
    assert not found.closed.any()
    assert not found.uncertain.any()


def test_a_router_says_what_it_could_not_pass_on_and_no_more():
    sent = every(200, 50)
    found = found_in(sent, [about(item, closed=0) for item in sent[10:20:3]], ends=ENDS)
    assert np.flatnonzero(found.refused).tolist() == [10, 13, 16, 19]
    assert not found.closed.any()
    assert not found.spans
    # It limits its errors: what follows within 1.2 s may have been refused, too.
    assert np.flatnonzero(found.uncertain).tolist() == [11, 12, 14, 15, 17, 18, 20, 21, 22, 23, 24]


def test_errors_about_fragments_come_late_and_those_about_the_last_never():
    """The receiver waits 5 s for fragments, and sends an error in 1.2 s; the capture ends at 19.8 s."""
    sent = every(200, 100)
    errors = [(item[0] + 5000 * MS, *about(item, closed=0)[1:]) for item in sent[10:24:6]]
    found = found_in(sent, errors, reason=0x040B01)
    assert np.flatnonzero(found.refused).tolist() == [10, 16, 22]
    assert np.flatnonzero(found.uncertain).tolist() == [
        *range(11, 16),
        *range(17, 22),
        *range(23, 28),
        *range(75, 100),
    ]


def test_bursts_without_identification_are_told_apart():
    """IPv6 numbers nothing: three datagrams at once, then three errors."""
    sent = [(at * 500 * MS + part * 10_000, ROBOT, 0) for at in range(20) for part in range(3)]
    away = sent[15:30]
    errors = [(item[0] + 200_000, ROBOT, 0, 1) for item in away]
    found = found_in(sent, errors)
    assert np.flatnonzero(found.closed).tolist() == list(range(15, 30))
    assert len(found.spans) == 1


def test_an_error_long_after_is_about_another_datagram():
    sent = [(0, ROBOT, 5), (100 * SECOND, ROBOT, 6)]
    assert not found_in(sent, [(50 * SECOND, ROBOT, 5, 1)]).closed.any()


@settings(max_examples=examples(150))
@given(
    steps=st.lists(st.integers(1, 900), min_size=2, max_size=120),
    shut=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    limited=st.booleans(),
    lost=st.sets(st.integers(0, 119), max_size=10),
    unseen=st.sets(st.integers(0, 119), max_size=10),
    numbered=st.booleans(),
)
def test_proven_is_never_above_the_truth(steps, shut, limited, lost, unseen, numbered):
    """A port is shut once; errors are limited as Linux does, some are lost, some datagrams not captured."""
    times = np.cumsum(steps) * MS
    low, high = shut[0], shut[0] + shut[1]
    sent = [(int(when), ROBOT, at + 1 if numbered else 0) for at, when in enumerate(times)]
    tokens, last, errors = 6.0, int(times[0]), []
    for at, item in enumerate(sent):
        tokens, last = min(6.0, tokens + (item[0] - last) / SECOND), item[0]
        if low <= at < high and (not limited or tokens >= 1):
            tokens -= 1
            if at not in lost:
                errors.append(about(item))
    kept = [at for at in range(len(sent)) if at not in unseen]
    found = found_in([sent[at] for at in kept] or sent[:1], errors, ends=ENDS if limited else LOOP)
    if not kept:
        return
    truth = np.array([low <= at < high for at in kept])
    matched = not (unseen and not numbered)  # without numbers an error may be taken for another's
    if matched:
        assert not (found.closed & ~truth).any()
    assert found.closed.sum() <= truth.sum() + len(unseen)
    assert not (found.closed & found.uncertain).any()
    if not limited and matched:
        silent = {at for at in kept if low <= at < high and at in lost}
        assert truth.sum() - found.closed.sum() <= len(silent)
    ends = [span.end_ns for span in found.spans]
    assert ends == sorted(ends)
    for span in found.spans:
        assert span.start_ns <= span.last_ns <= span.end_ns


Q25 = "season3/q25_robot_off_then_bridge_off"
whole = cache(partial(frames, FOLDER / f"{Q25}.pcap.zst"))


def is_error(item):
    return item.data[23] == 1


def port_of(item):
    """Return the destination port of a datagram, or of the one that an error quotes."""
    at = 34 + (28 if is_error(item) else 0)
    return int.from_bytes(item.data[at + 2 : at + 4], "big")


def figures(result):
    rows = [row for row in result["balance"] if "port_closed" in row["lost_by"]]
    return {(row["hop"], row["msg_id"]): row["lost_by"]["port_closed"] for row in rows}


def examined(tmp_path, items):
    result = diagnosed(write(tmp_path / "x.pcap", items))
    assert sums(result) == []
    return result


def test_both_directions_of_a_real_capture(tmp_path):
    """60 commands to the robot and 75 packets of telemetry to the bridge; three more were not read."""
    result = examined(tmp_path, whole())
    found = figures(result)
    robot = {key: number for key, number in found.items() if key[0] == "port 127.0.0.1:8585"}
    assert robot == {("port 127.0.0.1:8585", "0x1827"): 60}
    assert sum(found.values()) - 60 == 75
    assert len(found) == 11
    assert (result["lost"], result["uncertain"]) == (136, 3)
    texts = [item["reason"] for item in result["verdicts"] if item["rule"] == "port_closed"]
    assert any("its own datagrams, 2.0 a second, stopped too" in text for text in texts)


def test_without_the_errors_nothing_is_said_of_ports(tmp_path):
    result = examined(tmp_path, [item for item in whole() if not is_error(item)])
    assert figures(result) == {}
    assert result["lost"] == 1


def test_errors_alone_are_no_evidence(tmp_path):
    result = diagnosed(write(tmp_path / "x.pcap", [item for item in whole() if is_error(item)]))
    assert (result["examined"], result["lost"], result["balance"]) == (0, 0, [])


def test_errors_whose_datagrams_are_not_there_prove_nothing(tmp_path):
    result = examined(tmp_path, [item for item in whole() if is_error(item) or port_of(item) != 8585])
    assert sum(figures(result).values()) == 75


def test_commands_to_a_cfs_that_is_gone_are_lost_before_ci(tmp_path):
    """Nobody listens on CI's port in the last 20 s: the host answers each command with an error."""
    items = [item for item in whole() if not is_error(item)]
    since = items[-1].time_ns - 20 * SECOND
    out = []
    for item in items:
        to_ci = port_of(item) == 1234
        if item.time_ns < since or to_ci:
            out.append(item)
        if item.time_ns >= since and to_ci:
            packet = bytes(item.data[:14]) + bytes(error_about(IP(item.data[14:])))
            out.append(Frame(item.time_ns + 9000, packet, len(packet)))
    gone = sum(item.time_ns >= since and port_of(item) == 1234 and not is_error(item) for item in out)
    result = examined(tmp_path, out)
    assert gone > HALF
    assert figures(result) == {("CI", "0x1827"): gone}
    (told,) = [item for item in result["verdicts"] if item["rule"] == "port_closed"]
    assert told["lost"] == gone


def silent_in(sent, voices_ms, errors=()):
    rows, recorder = rows_of(sent), Errors(errors, [at * MS for at in voices_ms])
    rows.link[:] = ROBOT_LINK.code
    found = Unreachable(rows, recorder, LOOP, {})
    found.add_silent(rows, recorder, LOOP)
    return found


def test_what_goes_to_a_robot_that_falls_silent_may_reach_nobody():
    """It sends each second, and nothing for 4 s; one that the capture missed is no silence."""
    found = silent_in(
        every(200, 100), [at for at in range(0, 20_000, 1000) if at not in {3000, *range(8000, 12_000)}]
    )
    (span,) = found.spans
    assert np.flatnonzero(found.uncertain).tolist() == list(range(36, 61))
    assert (span.errors, span.step_ns, span.end_ns) == (0, SECOND, 12 * SECOND)


def test_no_silence_of_a_robot_is_told_where_its_host_sends_errors_or_nothing_is_captured():
    voices = [at for at in range(0, 20_000, 1000) if not 8000 <= at < 12_000]
    sent = every(200, 100)
    assert not silent_in([item for item in sent if not 7100 < item[0] // MS < 11_900], voices).spans
    assert all(span.errors for span in silent_in(sent, voices, [about(sent[2])]).spans)


def test_a_robot_that_pauses_often_is_not_off():
    """It sends nine times at 5 Hz, then nothing for 3 s, ten times; only 20 s are a silence."""
    begins = [at * 4600 for at in range(10)]
    voices = [begin + at * 200 for begin in [*begins, 66_000] for at in range(9)]
    (span,) = silent_in(every(700, 100), voices).spans
    assert span.end_ns == 66 * SECOND
