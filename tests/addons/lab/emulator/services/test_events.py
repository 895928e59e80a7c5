from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.services.events import Event, EventServices
from edoras_tools.cfs.event_services import EventType
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe


def loss(text: str = "Msg Limit Err", event_id: int = 17) -> Event:
    return Event("CFE_SB", event_id, EventType.ERROR, text)


@pytest.fixture
def services() -> EventServices:
    services = EventServices(SimProfile())
    services.register("CFE_EVS", now=0)
    services.register("CFE_SB", now=0, stop_after={17: 16, 14: 4})
    services.register("SBN", now=0)
    return services


@pytest.mark.parametrize(("event_id", "passes"), [(17, 16), (14, 4)])
def test_a_filter_stops_an_event_after_so_many_and_a_reset_begins_anew(services, event_id, passes):
    for _ in range(2):
        sent = [services.report(loss(event_id=event_id), now=index * SECOND) for index in range(50)]
        assert [bool(item) for item in sent] == [True] * passes + [False] * (50 - passes)
        assert said(services, 14, "CFE_SB") == [
            "CFE_EVS 29: Reset All Filters Command Received with AppName = CFE_SB"
        ]


def said(services, function_code, app="", mask=None):
    payload = app.encode().ljust(20, b"\0") if app else b""
    return [
        str(item)
        for item in services.command(function_code, payload + bytes([mask] if mask is not None else []))
    ]


def test_an_app_may_be_silenced_as_a_whole_and_by_severity(services):
    debug, note = (Event("SBN", 1, kind, "x") for kind in (EventType.DEBUG, EventType.INFORMATION))

    def passes(*events):
        return [bool(services.report(event, now=0)) for event in events]

    assert passes(debug, note) == [False, True]
    assert said(services, 8, "SBN") == ["CFE_EVS 26: Disable App Events Command Received with AppName = SBN"]
    assert passes(debug, note) == [False, False]
    assert said(services, 7, "SBN") == ["CFE_EVS 25: Enable App Events Command Received with AppName = SBN"]
    said(services, 5, "SBN", 1)
    assert passes(debug, note) == [True, True]
    said(services, 6, "SBN", 3)
    assert passes(debug, note, loss()) == [False, False, True]
    said(services, 2, mask=3)
    assert passes(debug, note) == [True, True]
    said(services, 3, mask=0b1111)
    assert passes(debug, note, loss()) == [False, False, False]


def test_a_command_that_cannot_be_obeyed_says_why(services):
    assert said(services, 8, "NOBODY") == [
        "CFE_EVS 9: Disable App Events Command: Unable to retrieve application ID for NOBODY: CC = 8"
    ]
    assert said(services, 14, "NOBODY") == [
        "CFE_EVS 9: Unable to retrieve application ID for NOBODY: CC = 14"
    ]
    assert said(services, 2, mask=0) == ["CFE_EVS 40: Bit Mask = 0x00000000 out of range: CC = 2"]
    assert said(services, 5, "SBN", 16) == ["CFE_EVS 40: Bit Mask = 0x00000010 out of range: CC = 5"]
    assert said(services, 0) == []


def test_an_app_is_squelched_after_its_burst_and_gets_15_a_second_back(services):
    chatter = [Event("SBN", 4, EventType.INFORMATION, f"line {index}") for index in range(60)]
    told = [str(sent) for event in chatter for sent in services.report(event, now=0)]
    assert told == [
        *(f"SBN 4: line {index}" for index in range(32)),
        "CFE_EVS 44: Events squelched, AppName = SBN",
    ]
    # It pays for its insistence (a second's worth at most) before it may speak again.
    assert services.report(chatter[0], now=SECOND) == []
    later = [services.report(chatter[0], now=3 * SECOND) for _ in range(60)]
    assert 14 <= sum(sent == [chatter[0]] for sent in later) <= 30


def test_debug_events_and_those_of_unknown_apps_are_not_sent(services):
    assert services.report(Event("SBN", 1, EventType.DEBUG, "x"), now=0) == []
    assert services.report(Event("NOBODY", 1, EventType.ERROR, "x"), now=0) == []


def test_the_packet_is_the_capture_s(services):
    event = Event("TO_LAB_APP", 3, EventType.INFORMATION, "TO telemetry output enabled for IP 127.0.0.1")
    payload = services.payload(event)
    assert len(payload) == 172 - cfe.TELEMETRY_HEADER_BYTES
    expected = (
        "544f5f4c41425f4150500000000000000000000003000200420000000100000054"
        "4f2074656c656d65747279206f757470757420656e61626c656420666f7220495020"
    )
    assert payload.hex().startswith(expected)


@given(st.text(max_size=300), st.text(max_size=60))
def test_any_text_fits(text, app):
    payload = EventServices(SimProfile()).payload(Event(app, 1, EventType.ERROR, text))
    assert len(payload) == cfe.EVENT.size


@given(st.lists(st.integers(0, 2 * SECOND), max_size=200))
def test_in_the_long_run_no_app_sends_more_than_its_rate(steps):
    services = EventServices(SimProfile())
    services.register("SBN", now=0)
    now = sent = 0
    for step in steps:
        now += step
        sent += len(services.report(Event("SBN", 1, EventType.INFORMATION, ""), now=now))
    assert sent <= 32 + 15 * now / SECOND + 1
