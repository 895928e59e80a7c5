"""CI and TO as a ground bridge has them: transcripts."""

from __future__ import annotations

import pytest
from bare_cfs import BareCfs

from edoras_tools.addons.lab.emulator.apps.telemetry_output import TelemetryOutput
from edoras_tools.pipelines.sending.wait_for import enable_output
from edoras_tools.sessions.bridge.ground import ASK_NS, SILENCE_NS, STEP_NS, GroundSession
from edoras_tools.sessions.bridge.packets import PacketWriter
from edoras_tools.units import SECOND


@pytest.fixture
def session():
    return GroundSession(PacketWriter(), "127.0.0.1", now=0)


def test_it_asks_until_telemetry_comes(session):
    assert session.ready
    assert session.service(now=0) == [enable_output("127.0.0.1")]
    assert session.next_ns == ASK_NS
    assert session.service(now=ASK_NS - 1) == []
    assert session.service(now=ASK_NS) == [enable_output("127.0.0.1")]
    assert session.receive_datagram(b"any", now=ASK_NS + 5) == (0, [])
    assert session.notes == ["telemetry arrives"]
    assert session.next_ns == ASK_NS + 5 + SILENCE_NS


def test_a_cfs_that_falls_silent_is_asked_again_and_told_of_once(session):
    session.service(now=0)
    session.receive_datagram(b"", now=1)
    session.receive_datagram(b"", now=9 * SECOND)
    session.notes.clear()
    assert session.service(now=1 + SILENCE_NS) == []
    assert session.next_ns == 9 * SECOND + SILENCE_NS
    assert len(session.service(now=19 * SECOND)) == 1
    assert session.notes == ["no telemetry for 10 s: is cFS running, does its TO send here? asking again"]
    assert not session.summary()["connected"]
    for second in range(20, 80):
        session.service(now=second * SECOND)
    assert len(session.notes) == 1
    session.receive_datagram(b"", now=80 * SECOND)
    assert session.notes[1:] == ["telemetry arrives"]


def test_who_never_answers_is_told_of_once(session):
    asked = sum(len(session.service(now=tenth * SECOND // 10)) for tenth in range(600))
    assert session.notes == ["no telemetry for 10 s: is cFS running, does its TO send here? asking again"]
    assert asked == session.asked == 10


def test_what_the_mission_wants_in_the_table_is_added_and_real_to_takes_it():
    cfs = BareCfs()
    output = TelemetryOutput(cfs, [0x828])
    cfs.said()
    session = GroundSession(PacketWriter(checksum=True, sequence=True), "10.0.0.7", {0x828: 255}, now=0)
    for packet in session.service(now=0):
        output.command(packet)
    assert cfs.said() == [
        "TO_LAB_APP 3: TO telemetry output enabled for IP 10.0.0.7",
        "TO_LAB_APP 16: L497 TO RemovePkt 0x828",
        "TO_LAB_APP 15: L473 TO AddPkt 0x828, QoS 0.0, limit 255",
    ]
    assert output.pipe.limits[0x828] == 255


def test_no_more_is_asked_at_once_than_telemetry_output_takes():
    session = GroundSession(PacketWriter(), "10.0.0.7", dict.fromkeys(range(0x828, 0x82C), 20), now=0)
    bursts = [session.service(now=0)]
    session.receive_datagram(b"telemetry", now=1)  # the rest is asked for all the same
    while session.next_ns == len(bursts) * STEP_NS:
        bursts.append(session.service(now=session.next_ns))
    assert [len(burst) for burst in bursts] == [3, 4, 2]
    assert bursts[0][0] == enable_output("10.0.0.7")
    assert session.next_ns == 1 + SILENCE_NS
    assert (session.asked, session.hearing) == (1, True)


def test_telemetry_output_is_left_alone_where_that_is_wanted():
    session = GroundSession(PacketWriter(), None, now=0)
    assert session.next_ns is None
    assert session.service(now=SECOND) == []
    session.receive_datagram(b"", now=SECOND)
    assert session.next_ns is None
    session.sent(now=2)
    assert (session.goodbye(), session.frame(b"packet")) == ([], b"packet")
