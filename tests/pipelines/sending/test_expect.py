"""What has to come back after sending, beside an emulated cFS and packets made by hand."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.links.to import TO
from edoras_tools.pipelines.sending.expect import AwaitedResults
from edoras_tools.pipelines.sending.loop import SendReport
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

BENCH = Settings().workbench()
CONTEXT = BENCH.columns.context


def event(text):
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
        ("event:No-op", [], [event("No-op command")], True, "TO_LAB_APP 18: No-op command"),
        ("event:TO_LAB_APP 18", [], [event("No-op command")], True, "TO_LAB_APP 18: No-op command"),
        ("event:No-op", [event("No-op command")], [], False, "nothing came"),
        ("event:No-op", [], [event("a"), event("b")], False, "other events came: 2"),
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
