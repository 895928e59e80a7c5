"""CI and TO as a ground bridge has them: transcripts."""

from __future__ import annotations

import pytest
from bare_cfs import BareCfs
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.apps.network_apps import SbnNode, TelemetryOutput
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.sending.loop import enable_output
from edoras_tools.sessions.bridge import (
    ASK_NS,
    SILENCE_NS,
    STEP_NS,
    FlightSession,
    GroundSession,
    PacketWriter,
)
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.sbn import MsgType


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


US, CFS = Peer(0x42, 3), Peer(0x42, 1)
PACKET = PacketWriter().write(0x1829, bytes(20))


def subscriptions(kind, *msg_ids, peer=CFS, ident=sbn.IDENT):
    entries = [sbn.Subscription(item) for item in msg_ids]
    return sbn.emit(kind, peer, sbn.emit_subscriptions(entries, ident=ident))


def proto(version=sbn.PROTOCOL_VERSION):
    return sbn.emit(MsgType.PROTO, CFS, sbn.emit_proto(version))


HEARTBEAT = sbn.emit(MsgType.HEARTBEAT, CFS)
GOODBYE = sbn.emit(MsgType.DISCONNECT, CFS)


def said(datagrams):
    """What datagrams of ours are, in words."""
    words = []
    for data in datagrams:
        assert Peer(*(sbn.HEADER.parse(data)[name] for name in ("spacecraft_id", "processor_id"))) == US
        kind = MsgType(data[2])
        entries = sbn.parse_subscriptions(data[11:])[1] if kind in {MsgType.SUB, MsgType.UNSUB} else ()
        words.append(" ".join([kind.name, *(f"{item.msg_id:x}" for item in entries)]))
    return words


@pytest.fixture
def flight_session():
    return FlightSession(US, CFS, [0x82A, 0x82B], now=0)


@pytest.fixture
def connected(flight_session):
    flight_session.service(now=0)
    flight_session.receive_datagram(proto(), now=1)
    flight_session.receive_datagram(subscriptions(MsgType.SUB, 0x1829), now=1)
    return flight_session


def test_it_asks_once_a_second_and_subscribes_when_somebody_answers(flight_session):
    assert said(flight_session.service(now=0)) == ["DISCONNECT", "PROTO"]
    assert flight_session.next_ns == SECOND
    assert flight_session.service(now=SECOND - 1) == []
    assert said(flight_session.service(now=SECOND)) == ["PROTO"]
    assert (flight_session.ready, flight_session.notes) == (False, [])
    at, answers = flight_session.receive_datagram(proto(), now=SECOND + 5)
    assert (at, said(answers)) == (-1, ["PROTO", "SUB 82a 82b"])
    assert (flight_session.ready, flight_session.notes) == (True, ["connected to peer 66:1"])
    assert flight_session.receive_datagram(subscriptions(MsgType.SUB, 0x1829), now=SECOND + 6) == (-1, [])
    assert flight_session.connection.subscribed == {0x1829}


def test_a_cfs_that_speaks_first_is_answered_and_its_own_proto_is_no_restart(flight_session):
    assert said(flight_session.receive_datagram(subscriptions(MsgType.SUB, 0x1829), now=5)[1]) == [
        "PROTO",
        "SUB 82a 82b",
    ]
    assert flight_session.receive_datagram(proto(), now=9) == (-1, [])
    assert flight_session.receive_datagram(proto(), now=10) == (-1, [])
    assert flight_session.connections == 1


def test_an_application_message_connects_and_is_read(flight_session):
    at, answers = flight_session.receive_datagram(sbn.emit(MsgType.APP, CFS, PACKET), now=5)
    assert (at, said(answers)) == (11, ["PROTO", "SUB 82a 82b"])
    assert flight_session.receive_datagram(sbn.emit(MsgType.APP, CFS, PACKET), now=6) == (11, [])


def test_changes_are_said_once_each(connected):
    assert said(connected.want([0x82A, 0x82C, 0x82D], now=5)) == ["SUB 82c 82d", "UNSUB 82b"]
    assert connected.want([0x82A, 0x82C, 0x82D], now=6) == []
    assert said(connected.want([], now=7)) == ["UNSUB 82a 82c 82d"]
    assert said(connected.goodbye()) == ["DISCONNECT"]


def test_what_changes_before_a_connection_is_said_with_it(flight_session):
    assert flight_session.want([0x82C], now=0) == []
    assert said(flight_session.receive_datagram(HEARTBEAT, now=1)[1]) == ["PROTO", "SUB 82c"]


def test_heartbeats_go_out_only_after_six_idle_seconds(connected):
    connected.receive_datagram(HEARTBEAT, now=SECOND)
    connected.sent(now=SECOND)
    assert connected.next_ns == 7 * SECOND
    assert connected.service(now=7 * SECOND - 1) == []
    assert said(connected.service(now=7 * SECOND)) == ["HEARTBEAT"]
    assert connected.service(now=7 * SECOND) == []


def test_a_disconnect_is_a_loss_and_it_asks_again_at_once(connected):
    connected.notes.clear()
    assert connected.receive_datagram(GOODBYE, now=9) == (-1, [])
    assert (connected.ready, connected.losses) == (False, {"disconnect": 1, "timeout": 0})
    assert connected.notes == ["peer 66:1 disconnected; asking again"]
    assert connected.receive_datagram(GOODBYE, now=9) == (-1, [])
    assert said(connected.service(now=9)) == ["DISCONNECT", "PROTO"]
    assert said(connected.receive_datagram(proto(), now=10)[1]) == ["PROTO", "SUB 82a 82b"]
    assert (connected.ready, connected.connections) == (True, 2)


def test_eleven_silent_seconds_are_a_loss_and_it_asks_again_at_once(connected):
    connected.receive_datagram(HEARTBEAT, now=SECOND)
    connected.sent(now=11 * SECOND)
    connected.notes.clear()
    assert connected.service(now=12 * SECOND - 1) == []
    assert connected.ready
    assert said(connected.service(now=12 * SECOND)) == ["DISCONNECT", "PROTO"]
    assert (connected.ready, connected.losses) == (False, {"disconnect": 0, "timeout": 1})
    assert connected.notes == ["nothing from peer 66:1 for 11 s: connection lost; asking again"]
    assert said(connected.receive_datagram(HEARTBEAT, now=13 * SECOND)[1]) == ["PROTO", "SUB 82a 82b"]


def test_a_cfs_that_started_anew_meanwhile_is_told_all_once_more(connected):
    assert said(connected.receive_datagram(proto(), now=3 * SECOND)[1]) == ["SUB 82a 82b"]
    assert connected.connection.subscribed == set()
    assert connected.receive_datagram(proto(), now=3 * SECOND + 1) == (-1, [])
    assert connected.connections == 1


def test_another_protocol_version_is_told_once_and_the_rest_goes_on(flight_session):
    assert said(flight_session.receive_datagram(proto(10), now=1)[1]) == ["PROTO", "SUB 82a 82b"]
    flight_session.receive_datagram(proto(10), now=2)
    assert flight_session.notes == [
        "connected to peer 66:1",
        "peer 66:1 speaks SBN protocol 10, this side 11: it may refuse messages; continuing",
    ]
    assert flight_session.receive_datagram(sbn.emit(MsgType.APP, CFS, PACKET), now=3) == (11, [])


def test_another_build_of_sbn_is_told_and_its_wishes_are_heard(connected):
    connected.notes.clear()
    connected.receive_datagram(subscriptions(MsgType.SUB, 0x182A, ident="$Id: 0 $"), now=5)
    assert connected.notes == ["peer 66:1 is another SBN ($Id: 0 $): it will refuse our subscriptions"]
    assert connected.connection.subscribed == {0x1829, 0x182A}


def test_the_older_header_is_told_and_not_understood(flight_session):
    data = (12).to_bytes(2, "big") + bytes([MsgType.APP]) + (1).to_bytes(4, "big") + bytes(12)
    assert flight_session.receive_datagram(data, now=1) == (-1, [])
    assert flight_session.refused == {"SBN header of 7 bytes": 1}
    assert "header of 7 bytes instead of 11" in flight_session.notes[0]


def test_strangers_are_refused_and_told_once(flight_session):
    for _ in range(3):
        flight_session.receive_datagram(sbn.emit(MsgType.HEARTBEAT, Peer(0x42, 9)), now=1)
    flight_session.receive_datagram(b"\xff\xff" + HEARTBEAT[2:], now=1)
    flight_session.receive_datagram(b"short", now=1)
    flight_session.receive_datagram(b"", now=1)
    assert flight_session.refused == {"peer 66:9": 3, "SBN size below 0": 1, "shorter than an SBN header": 2}
    assert flight_session.notes == ["peer 66:9 sends here, but the file expects 66:1: refused"]
    assert not flight_session.ready


def test_what_is_malformed_is_counted(connected):
    connected.receive_datagram(sbn.emit(7, CFS), now=1)
    connected.receive_datagram(subscriptions(MsgType.SUB, 0x1829)[:-1], now=1)
    connected.receive_datagram(sbn.emit(MsgType.PROTO, CFS), now=1)
    assert connected.refused == {"unknown SBN message type 0x07": 1, "subscriptions cut short": 1}


def test_a_msg_id_that_cfs_does_not_want_is_told_once(connected):
    connected.notes.clear()
    other = PacketWriter().write(0x18EE, bytes(20))
    for now in (SECOND, 3 * SECOND, 4 * SECOND):
        for packet in (PACKET, other):
            assert connected.frame(packet) == sbn.emit(MsgType.APP, US, packet)
        connected.sent(now=now)
    (note,) = connected.notes
    assert note.startswith("cFS has not subscribed to 0x18EE: no application there receives it; ")


def test_it_says_goodbye_where_it_is_connected(flight_session, connected):
    assert said(connected.goodbye()) == ["UNSUB 82a 82b", "DISCONNECT"]
    assert FlightSession(US, CFS, [1], now=0).goodbye() == []


class Meeting:
    """Our session and the emulated SBN, over a wire that can be cut."""

    def __init__(self, msg_ids):
        self.profile = SimProfile()
        self.session = FlightSession(US, CFS, msg_ids, now=0)
        self.now, self.cut, self.ours = 0, False, []
        self.boot()

    def boot(self):
        self.cfs = BareCfs(self.profile).at(self.now)
        bus = self.cfs.bus
        bus.subscribe(bus.create_pipe("EDORAS_APP_PIPE", 32), 0x1829, 4)
        self.node = SbnNode(self.cfs)

    def send(self, datagrams):
        """Ours to cFS, and what it answers."""
        self.ours += [(self.now, word) for word in said(datagrams)]
        for data in datagrams:
            if not self.cut:
                self.cfs.at(self.now)
                self.node.receive_datagram(data)
                self.give()

    def give(self):
        """What cFS has sent to us."""
        to_us = [Endpoint(item.address, item.port) for item in self.profile.sbn_peers if item.peer == US]
        for to, data in self.cfs.take_sent():
            if to in to_us and not self.cut:
                self.send(self.session.receive_datagram(data, now=self.now)[1])

    def run(self, seconds, rate_hz=0):
        """Let time pass; publish at a rate."""
        step, end = 20 * MILLISECOND, self.now + seconds * SECOND
        due = self.now
        while self.now < end:
            if self.session.next_ns <= self.now:
                self.send(self.session.service(now=self.now))
            if rate_hz and due <= self.now and self.session.ready:
                due += SECOND // rate_hz
                self.send([self.session.frame(PACKET)])
                self.session.sent(now=self.now)
            if self.now % self.profile.sbn_wake_ns == 0:
                self.cfs.at(self.now)
                self.node.service()
                self.give()
            self.now += step

    def count(self, word, since=0):
        return sum(item.startswith(word) for time, item in self.ours if time >= since)

    @property
    def limits(self):
        return set(self.node.peers[US].pipe.limits)


def test_ten_minutes_have_one_sub_a_change_and_heartbeats_only_when_idle():
    meeting = Meeting([0x82A])
    meeting.run(200, rate_hz=5)
    assert (meeting.count("SUB"), meeting.count("UNSUB"), meeting.count("HEARTBEAT")) == (1, 0, 0)
    meeting.send(meeting.session.want([0x82A, 0x82B], now=meeting.now))
    idle = meeting.now
    meeting.run(300)
    assert [word for _, word in meeting.ours if "SUB" in word] == ["SUB 82a", "SUB 82b"]
    beats = [time for time, word in meeting.ours if word == "HEARTBEAT"]
    assert len(beats) == 50 - 1
    assert min(beats) - idle >= 6 * SECOND
    meeting.send(meeting.session.want([0x82B], now=meeting.now))
    busy = meeting.now
    meeting.run(100, rate_hz=5)
    assert [word for _, word in meeting.ours if "SUB" in word] == ["SUB 82a", "SUB 82b", "UNSUB 82a"]
    assert meeting.count("HEARTBEAT", since=busy) == 0
    assert meeting.limits == {0x82B}
    assert meeting.session.connections == 1
    assert meeting.session.connection.subscribed == {0x1829}


def test_it_comes_back_after_a_cut_wire_a_goodbye_and_a_restart():
    meeting = Meeting([0x82A, 0x82B])
    meeting.run(5)
    assert meeting.limits == {0x82A, 0x82B}
    meeting.cut = True
    meeting.run(20)
    assert (meeting.session.ready, meeting.session.losses["timeout"]) == (False, 1)
    meeting.cut = False
    meeting.run(15)
    assert meeting.session.ready
    assert meeting.limits == {0x82A, 0x82B}
    meeting.session.receive_datagram(GOODBYE, now=meeting.now)
    meeting.run(3)
    assert (meeting.session.ready, meeting.session.losses["disconnect"]) == (True, 1)
    before = meeting.count("SUB")
    meeting.boot()  # within the eleven seconds: nobody notices but by its PROTO
    meeting.run(10, rate_hz=2)
    assert meeting.count("SUB") == before + 1
    assert meeting.limits == {0x82A, 0x82B}


@st.composite
def datagrams(draw):
    """Of the peer or anybody, of any kind, often cut."""
    peer = draw(st.sampled_from([CFS, CFS, CFS, Peer(1, 2)]))
    kind = draw(st.sampled_from([*MsgType, 7]))
    payload = draw(st.binary(max_size=90))
    if kind in {MsgType.SUB, MsgType.UNSUB} and draw(st.booleans()):
        payload = sbn.emit_subscriptions(sbn.Subscription(item) for item in draw(st.lists(st.integers(0, 9))))
    data = sbn.emit(kind, peer, payload)
    return data[: draw(st.integers(0, len(data)))] if draw(st.integers(0, 4)) == 0 else data


@given(
    st.lists(
        st.tuples(st.integers(0, 12 * SECOND), st.binary(max_size=30) | datagrams() | st.none()), max_size=40
    )
)
def test_whatever_comes_it_only_says_what_a_peer_says(steps):
    flight_session = FlightSession(US, CFS, [0x82A], now=0)
    now, connections = 0, 0
    for step, data in steps:
        now += step
        out = flight_session.service(now=now)
        if data is not None:
            at, answers = flight_session.receive_datagram(data, now=now)
            out = out + answers
            assert at in {-1, 11}
            assert at == -1 or len(data) >= 11
        words = said(out)
        connections += "SUB 82a" in words
        assert len(words) <= 4
        assert flight_session.next_ns >= now - 12 * SECOND
        assert (
            not flight_session.ready or now - flight_session.connection._heard_ns < 11 * SECOND + 12 * SECOND
        )
    assert flight_session.connections <= connections <= len(steps)
    assert sum(flight_session.losses.values()) <= flight_session.connections
    said(flight_session.goodbye())
