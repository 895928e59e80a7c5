from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.links import table
from edoras_tools.links.bare import TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission
from edoras_tools.mission.model import Route
from edoras_tools.model import OTHER, Peer
from edoras_tools.pipelines.sending.loop import SendReport
from edoras_tools.pipelines.sending.responses import AwaitedResults, IngestCount, Responses
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn


def account(*steps):
    """Follow steps: ``begin``, ``("sent", n)`` or the count of a report."""
    ingest = IngestCount()
    for step in steps:
        if step == "begin":
            ingest.begin()
        elif isinstance(step, tuple):
            ingest.sent = step[1]
        else:
            ingest.reported(step)
    return ingest


@pytest.mark.parametrize(
    ("steps", "state", "read", "missing", "final"),
    [
        # known before: exact
        ([7, "begin", ("sent", 5), 12], "all", 5, 0, True),
        ([7, "begin", ("sent", 5), 9], "waiting", 2, None, False),
        ([7, "begin", ("sent", 5), 9, 9], "waiting", 2, None, False),
        ([7, "begin", ("sent", 5), 9, 9, 9], "missing", 2, 3, True),
        ([7, "begin", ("sent", 5), 9, 9, 11, 12], "all", 5, 0, True),
        ([7, "begin", ("sent", 5)], "unknown", None, None, False),
        ([7, "begin", ("sent", 5), 30], "others", None, None, True),
        # a report that stood still while more was sent is none that repeats the last
        ([7, "begin", ("sent", 5), 9, ("sent", 9), 9, 9], "waiting", 2, None, False),
        # asked for telemetry first: known once the count stands still, and what asked is not part of it
        ([("sent", 1), 8, 8, "begin", ("sent", 4), 11], "all", 3, 0, True),
        ([("sent", 1), 7, 8, 8, "begin", ("sent", 4), 10, 10, 10], "missing", 2, 1, True),
        ([("sent", 1), 8, "begin", ("sent", 4), 10, 10, 10], "partly", 2, None, True),
        # first heard after the beginning
        (["begin", ("sent", 3), 50, ("sent", 9), 55, 55, 55], "partly", 5, None, True),
        (["begin", ("sent", 1), 50, 51], "all", 1, 0, True),
        (["begin", ("sent", 1), 50, 50, 50], "unknown", None, None, True),
        (["begin", ("sent", 1)], "unknown", None, None, False),
        # a count that falls
        ([7, "begin", ("sent", 5), 9, 2, 3], "restarted", None, None, False),
        ([7, 3, "begin", ("sent", 5), 8], "all", 5, 0, True),
    ],
)
def test_what_a_count_shows(steps, state, read, missing, final):
    ingest = account(*steps)
    summary = ingest.summary()
    assert (summary["state"], summary["read"], summary["missing"]) == (state, read, missing)
    assert ingest.is_final == final


def test_known_exactly_before_anything_is_sent_or_once_it_stands_still():
    assert not account().is_known
    assert account(7).is_known
    assert not account(("sent", 2), 9).is_known
    assert not account(("sent", 2), 8, 9).is_known
    assert account(("sent", 2), 8, 9, 9).is_known


def test_only_what_is_proved_counts_as_missing():
    assert account(7, "begin", ("sent", 5), 9).missing == 0
    assert account(7, "begin", ("sent", 5), 9, 9, 9).missing == 3
    assert account("begin", ("sent", 5), 9, 9, 9).missing == 0
    assert account().missing == 0


MISSION = Mission(routes=(Route("/pose", "geometry_msgs/msg/PoseStamped", 0x0827, TO, "telemetry"),))


def event(text, kind=3, event_id=17):
    body = struct.pack("<20sHHII122s2x", b"CFE_SB", event_id, kind, 66, 1, text.encode())
    return cfe.emit_telemetry(0x808, body)


def housekeeping(overflows, limits, others=0):
    return cfe.emit_telemetry(
        0x803, bytes([0, 0, 0, others]) + bytes(8) + struct.pack("<HHIII", overflows, limits, 0, 0, 0)
    )


def test_events_are_told_once_and_counted():
    seen = Responses(MISSION)
    for now, text in enumerate(["lost\n", "lost\n", "other"]):
        seen.add(TO, event(text), now)
    events = seen.summary()["events"]
    assert [(item["message"], item["count"], item["time_ns"]) for item in events] == [
        ("lost", 2, 0),
        ("other", 1, 2),
    ]
    assert events[0].items() >= {"app": "CFE_SB", "event_id": 17, "event_type": "error"}.items()
    assert seen.says("CFE_SB 17: lo")
    assert not seen.says("nothing")


def test_a_packet_of_another_length_is_not_ci_s_count():
    seen = Responses(MISSION)
    seen.add(TO, cfe.emit_telemetry(0x884, bytes(284)), 0)
    assert seen.ingest.reports == 0
    seen.add(TO, cfe.emit_telemetry(0x884, bytes(24)), 1)
    assert seen.ingest.reports == 1
    seen.add(TO, cfe.emit_telemetry(0x884, bytes(12)), 2)  # of cFS 7
    assert seen.ingest.reports == 2


def test_counters_tell_what_was_gained():
    seen = Responses(MISSION)
    for overflows, limits in ((3, 10), (3, 12), (3, 60)):
        seen.add(TO, housekeeping(overflows, limits), 0)
    assert seen.summary()["counters"] == {
        "pipe_overflow_error_counter": {"first": 3, "last": 3, "gained": 0},
        "message_limit_error_counter": {"first": 10, "last": 60, "gained": 50},
    }
    assert seen.lost == 50


def test_a_counter_that_changed_is_told_and_one_goes_round():
    seen = Responses(MISSION)
    seen.add(TO, housekeeping(65_530, 0, others=5), 0)
    seen.add(TO, housekeeping(4, 0, others=9), 0)
    counters = seen.summary()["counters"]
    assert counters["message_send_error_counter"]["gained"] == 4
    assert counters["pipe_overflow_error_counter"]["gained"] == 10


def test_packets_are_counted_by_link_and_msg_id():
    seen = Responses(MISSION)
    peer = Peer(0x42, 1)
    seen.add(TO, cfe.emit_telemetry(0x827, b"x"), 0)
    seen.add(TO, cfe.emit_telemetry(0x827, b"y"), 0)
    seen.add(SBN, sbn.emit(sbn.MsgType.APP, peer, cfe.emit_telemetry(0x82A)), 0)
    seen.add(SBN, sbn.emit(sbn.MsgType.HEARTBEAT, peer), 0)
    summary = seen.summary()
    assert [
        (item["link"], item["msg_id"], item["topic"], item["count"]) for item in summary["telemetry"]
    ] == [
        ("to", "0x0827", "/pose", 2),
        ("sbn", "0x082a", None, 1),
    ]
    assert summary["sbn"] == {"HEARTBEAT": 1}
    assert seen.telemetry == 2


def test_nothing_heard_is_nothing_lost():
    assert Responses(MISSION).lost == 0
    nothing = {"events": [], "counters": {}, "telemetry": [], "sbn": {}, "answers": 0}
    assert Responses(MISSION).summary() == nothing


@given(st.lists(st.tuples(st.sampled_from([OTHER, *table.links()]), st.binary(max_size=200)), max_size=30))
def test_any_bytes_are_counted_or_left_out(datagrams):
    seen = Responses(MISSION)
    for link, data in datagrams:
        seen.add(link, data, 0)
        seen.add(link, event("x")[:16] + data, 0)
        seen.add(link, housekeeping(1, 1)[:16] + data, 0)
    seen.summary()


BENCH = Settings().workbench()
CONTEXT = BENCH.columns.context


def log_event(text):
    return cfe.emit_telemetry(
        0x808, struct.pack("<20sHHII122s2x", b"TO_LAB_APP", 18, 2, 66, 1, text.encode())
    )


def output_housekeeping(counter, errors=0):
    return cfe.emit_telemetry(0x880, bytes([counter, errors, 0, 0]))


def bus_housekeeping(lost):
    return cfe.emit_telemetry(0x803, bytes(12) + struct.pack("<HHIII", lost, 0, 0, 0, 0))


def expected(*texts):
    return AwaitedResults.of(texts, SECOND, CONTEXT)


@pytest.mark.parametrize(
    ("text", "before", "after", "met", "found"),
    [
        ("event:No-op", [], [log_event("No-op command")], True, "TO_LAB_APP 18: No-op command"),
        ("event:TO_LAB_APP 18", [], [log_event("No-op command")], True, "TO_LAB_APP 18: No-op command"),
        ("event:No-op", [log_event("No-op command")], [], False, "nothing came"),
        ("event:No-op", [], [log_event("a"), log_event("b")], False, "other events came: 2"),
        ("TO_HK", [], [output_housekeeping(1)], True, "came once"),
        ("0x0880", [], [output_housekeeping(1)] * 3, True, "came 3 times"),
        ("TO_*", [output_housekeeping(1)], [], False, "nothing came"),
        ("counter:TO_HK.command_counter", [output_housekeeping(7)], [output_housekeeping(8)], True, "7 → 8"),
        ("counter:TO_HK.command_counter", [output_housekeeping(7)], [output_housekeeping(7)], False, "7 → 7"),
        (
            "counter:TO_HK.command_counter+2",
            [output_housekeeping(7)],
            [output_housekeeping(8)],
            False,
            "7 → 8",
        ),
        (
            "counter:0x880.command_counter+2",
            [output_housekeeping(7)],
            [output_housekeeping(9)],
            True,
            "7 → 9",
        ),
        ("counter:TO_HK.command_counter", [], [output_housekeeping(5)], False, "5 → 5"),
        (
            "counter:TO_HK.command_counter",
            [output_housekeeping(255)],
            [output_housekeeping(0)],
            False,
            "255 → 0",
        ),
        ("counter:TO_HK.command_counter", [], [cfe.emit_telemetry(0x880, b"")], False, "nothing came"),
    ],
)
def test_what_comes_before_sending_does_not_count(text, before, after, met, found):
    items = expected(text)
    for data in before:
        items.take(data)
    items.begin()
    for data in after:
        items.take(data)
    assert items.as_json() == [{"expect": text, "met": met, "found": found}]
    assert bool(items.missing) is not met


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("event:", ConfigError, "is not known"),
        ("peer:x", ConfigError, "is not known"),
        ("", ConfigError, "is not known"),
        ("counter:TO_HK", ConfigError, "names no counter"),
        ("counter:TO_HK.command_counter+x", ConfigError, "names no counter"),
        ("counter:TO_HK.nothing", ConfigError, "there are command_counter"),
        ("counter:SBN_HK.x", ConfigError, "no C struct is known for SBN_HK"),
        ("counter:TO_HX.x", RouteError, "did you mean TO_HK?"),
        ("SBN_PROTO", ConfigError, "it has no MsgId"),
    ],
)
def test_refused(text, error, words):
    with pytest.raises(error) as told:
        expected(text)
    assert words in str(told.value)


@given(st.binary(min_size=2, max_size=300), st.sampled_from([b"\x08\x80", b"\x08\x08", b"\x08\x03"]))
def test_any_bytes_are_taken(data, head):
    items = expected("event:x", "TO_HK", "counter:TO_HK.command_counter", "counter:SB_HK.command_counter")
    items.begin()
    for packet in (data, head + data[2:]):
        items.take(packet)


@pytest.mark.parametrize(
    ("most", "lost", "told"),
    [
        (None, 5, ""),
        (0.1, 5, ""),
        (0.01, 5, "5 of 100 lost (5.00%), allowed 1.00%"),
        (0.0, 0, ""),
        (0.1, None, "is not known"),
    ],
)
def test_losses_up_to_a_share(most, lost, told):
    responses = Responses(BENCH.mission)
    for value in () if lost is None else (10, 10 + lost):
        responses.add(TO, bus_housekeeping(value), 0)
    report = SendReport(responses, 100, None, sent=100)
    reasons = report.beyond(most)
    assert bool(reasons) is bool(told)
    assert told in "".join(reasons)
