from __future__ import annotations

import pytest
from bare_cfs import BareCfs
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.apps.network_apps import TelemetryOutput
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe


@pytest.fixture
def cfs() -> BareCfs:
    return BareCfs()


@pytest.fixture
def output(cfs) -> TelemetryOutput:
    cfs.events.register("CFE_SB", now=0)
    return TelemetryOutput(cfs)


@pytest.fixture
def tell(cfs, output):
    def tell(function_code: int, payload: bytes = b"") -> str:
        cfs.said()
        output.command(cfe.emit_command(0x1880, function_code, payload))
        return "; ".join(cfs.said())

    return tell


@pytest.mark.parametrize(
    ("function_code", "payload", "says", "destination"),
    [
        (6, b"127.0.0.1".ljust(16, b"\0"), "3: TO telemetry output enabled for IP 127.0.0.1", "127.0.0.1"),
        (6, b"10.0.0.9".ljust(20, b"\0"), "3: TO telemetry output enabled for IP 10.0.0.9", "10.0.0.9"),
        (6, b"127.", "3: TO telemetry output enabled for IP 127.", "127.0.0.1"),
        (77, b"", "9: L344 TO: Invalid Function Code Rcvd In Ground Command 0x4d", None),
        (2, bytes.fromhex("f108000000000800"), "15: L473 TO AddPkt 0x8f1, QoS 0.0, limit 8", None),
        (4, bytes.fromhex("27080000"), "16: L497 TO RemovePkt 0x827", None),
        (0, b"", "18: No-op command", None),
        (1, b"", "", None),
        (5, b"", "17: L527 TO Unsubscribed to all Commands and Telemetry", None),
        (2, bytes.fromhex("f1280000"), "10: L470 TO Can't subscribe 0x28f1 status -905969661", None),
        (
            4,
            bytes.fromhex("f1280000"),
            "11: L494 TO Can't Unsubscribe to Stream 0x28f1, status -905969661",
            None,
        ),
    ],
)
def test_commands(output, tell, function_code, payload, says, destination):
    assert tell(function_code, payload) == (f"TO_LAB_APP {says}" if says else "")
    assert output.destination == destination


def test_what_is_added_twice_and_what_is_not_there_is_the_bus_s_to_say(tell):
    assert tell(2, bytes.fromhex("2708000000000400")) == (
        "CFE_SB 7: Duplicate Subscription,MsgId 0x827 on TO_LAB_TLM_PIPE pipe,app TO_LAB_APP; "
        "TO_LAB_APP 15: L473 TO AddPkt 0x827, QoS 0.0, limit 4"
    )
    assert tell(4, bytes.fromhex("f1080000")) == (
        "CFE_SB 12: Unsubscribe Err:No subs for Msg 0x8f1 on TO_LAB_TLM_PIPE,app TO_LAB_APP; "
        "TO_LAB_APP 16: L497 TO RemovePkt 0x8f1"
    )


def test_add_and_remove_change_what_is_forwarded(cfs, output, tell):
    tell(6, b"127.0.0.1")
    packet = cfe.emit_telemetry(0x08F1, b"x")

    def is_forwarded() -> bool:
        cfs.publish(packet, "APP", stamp=False)
        while output.forward():
            pass
        return (Endpoint("127.0.0.1", 1235), packet) in cfs.take_sent()

    assert not is_forwarded()
    tell(2, bytes.fromhex("f108000000000800"))
    assert output.pipe.limits[0x08F1] == 8
    assert is_forwarded()
    tell(4, bytes.fromhex("f1080000"))
    assert not is_forwarded()


def test_before_the_first_enable_the_pipe_is_emptied_for_nobody(cfs, output):
    while output.forward():  # its own first event
        pass
    cfs.publish(cfe.emit_telemetry(0x0827), "APP", stamp=False)
    assert [output.forward(), output.forward()] == [True, False]
    assert cfs.take_sent() == []


def test_counters(output, tell):
    tell(0)
    tell(77)
    assert output.housekeeping().hex() == "01010000"
    tell(1)
    assert output.housekeeping().hex() == "00000000"


@given(st.integers(0, 127), st.binary(max_size=40))
def test_any_command_is_taken_or_refused(function_code, payload):
    output = TelemetryOutput(BareCfs())
    output.command(cfe.emit_command(0x1880, function_code, payload))
    assert output.commands + output.command_errors == (function_code != 1)
