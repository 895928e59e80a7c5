from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.flight_bridge import POLL_NS, FlightBridge
from edoras_tools.wire import cfe, sbn

CFS = sbn.Peer(0x42, 1)
TWIST = cfe.emit_telemetry(0x082A, bytes(80))


def bridge() -> FlightBridge:
    return FlightBridge([0x082A, 0x082B], now=0)


def kinds(sends: list[bytes]) -> list[str]:
    return [sbn.MsgType(item[2]).name for item in sends]


def test_it_subscribes_each_500_ms_for_good():
    flight = bridge()
    sent = [kinds(flight.poll(now=index * POLL_NS).sends) for index in range(11)]
    assert sent == [["SUB", "SUB"] if index % 5 == 0 else [] for index in range(11)]


def test_it_answers_every_datagram_and_stops_at_the_first_that_is_no_message():
    flight = bridge()
    flight.poll(now=0)
    app = sbn.emit(sbn.MsgType.APP, CFS, TWIST)
    for data in (app, app, sbn.emit(sbn.MsgType.HEARTBEAT, CFS), app):
        flight.receive_datagram(data)
    first, second = flight.poll(now=POLL_NS), flight.poll(now=2 * POLL_NS)
    assert kinds(first.sends) == ["PROTO", "PROTO", "PROTO", "HEARTBEAT"]
    assert first.packets == [TWIST, TWIST]
    assert (kinds(second.sends), second.packets) == (["PROTO"], [TWIST])


def test_lengths_below_11_modulo_256_are_lost():
    flight = bridge()
    flight.poll(now=0)
    sizes = (255, 256, 266, 267, 512)
    for size in sizes:
        flight.receive_datagram(sbn.emit(sbn.MsgType.APP, CFS, bytes(size - sbn.HEADER.size)))
    polled = flight.poll(now=POLL_NS)
    assert [len(item) + sbn.HEADER.size for item in polled.packets] == [255, 267]
    assert polled.dropped == 3


@given(st.lists(st.binary(max_size=600), max_size=20))
def test_any_datagram_is_dropped_or_answered(datagrams):
    flight = bridge()
    for data in datagrams:
        flight.receive_datagram(data)
    answered = dropped = 0
    for index in range(len(datagrams) + 1):
        polled = flight.poll(now=index * POLL_NS)
        answered += kinds([item for item in polled.sends if item[2] == sbn.MsgType.PROTO]).count("PROTO")
        dropped += polled.dropped
    assert answered + dropped == len(datagrams)
    assert dropped == sum(len(data) % 256 < 11 for data in datagrams)
