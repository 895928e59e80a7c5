from __future__ import annotations

import pytest
from bare_cfs import BareCfs
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.apps.network_apps import SbnNode
from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

BRIDGE = Peer(0x42, 3)
PROFILE = SimProfile(sbn_peers=(SbnPeerConfig(BRIDGE, 2236),))
MISMATCH = "SBN protocol version mismatch with peer 66:3, my version=11, peer version 10"
RESTART = "SBN 5: Creating recv task for net 0"
FAILED = "SBN 10: SBN_ProcessNetMsg failed: 0x00000001"
NOT_RECEIVED = "SBN 10: ERROR: during SBN Receive Net Task: RecvFromNet failed for net 0: status=0x00000001"
CONNECTED = [
    "SBN 259: connecting to peer 66:3",
    "SBN 5: Created peer pipe 'SBN_3_66_Pipe'",
    "SBN 5: Peer 66:3 connected.",
]


def datagram(msg_type: int, payload: bytes = b"", peer: Peer = BRIDGE) -> bytes:
    return sbn.emit(msg_type, peer, payload)


def sub(*msg_ids: int, msg_type: int = sbn.MsgType.SUB, ident: str = sbn.IDENT) -> bytes:
    return datagram(msg_type, sbn.emit_subscriptions(map(sbn.Subscription, msg_ids), ident=ident))


class Node(SbnNode):
    """The node on a cFS without applications."""

    def __init__(self, profile: SimProfile = PROFILE) -> None:
        self.cfs = BareCfs(profile)
        self.bus = self.cfs.bus
        self.cfs.events.register("SBN", now=0)
        super().__init__(self.cfs)

    def receives(self, data: bytes, now: int = 0) -> list[str]:
        """Receive a datagram; return the events."""
        self.cfs.at(now).said()
        self.receive_datagram(data)
        return self.cfs.said()

    def serves(self, now: int = 0) -> list[tuple[str, bytes]]:
        """Do a round; return what is sent in it."""
        self.cfs.at(now).take_sent()
        self.service()
        return self.sends()

    def sends(self) -> list[tuple[str, bytes]]:
        """Return the datagrams since the last call."""
        return [(sbn.MsgType(data[2]).name, data[11:]) for _, data in self.cfs.take_sent()]


@pytest.fixture
def node() -> Node:
    node = Node()
    pipe = node.bus.create_pipe("EDORAS_APP_PIPE", 32)
    for item in (0x1827, 0x1829, cfe.EVENT_MSG_ID):
        node.bus.subscribe(pipe, item)
    return node


def test_the_first_sub_connects_and_is_answered_with_proto_and_all_subscriptions(node):
    assert node.receives(sub(0x082A), SECOND) == CONNECTED
    known = sbn.emit_subscriptions([sbn.Subscription(0x1827), sbn.Subscription(0x1829)])
    assert node.sends() == [("PROTO", b"\x0b"), ("SUB", known)]
    assert node.receives(sub(0x082A), SECOND) == []


def test_subscriptions_go_to_every_peer_of_the_table_connected_or_not_one_a_datagram(node):
    expected = [("SUB", sbn.emit_subscriptions([sbn.Subscription(item)])) for item in (0x1827, 0x1829)]
    assert node.serves() == expected
    assert node.serves() == []
    pipe = node.bus.create_pipe("TO_LAB_TLM_PIPE", 50)
    node.bus.subscribe(pipe, 0x08F1)
    assert node.serves() == [("SUB", sbn.emit_subscriptions([sbn.Subscription(0x08F1)]))]
    node.bus.unsubscribe(pipe, 0x08F1)
    assert node.serves() == []  # never an UNSUB


def test_messages_cross_both_ways_eight_of_a_msg_id_a_round(node):
    node.receives(sub(0x082A))
    node.serves()
    packet = cfe.emit_telemetry(0x082A, bytes(80))
    publications = [node.bus.publish(packet, "EDORAS_APP", stamp=False) for _ in range(10)]
    assert [str(event) for item in publications for event in item.events] == [
        "CFE_SB 17: Msg Limit Err,MsgId 0x82a,pipe SBN_3_66_Pipe,sender EDORAS_APP"
    ] * 2
    assert node.serves() == [("APP", packet)] * 8
    command = cfe.emit_command(0x1829, 1, bytes(100))
    assert node.receives(datagram(sbn.MsgType.APP, command)) == []
    assert node.cfs.published == [command]


def test_what_a_peer_unsubscribes_no_longer_goes_to_it(node):
    node.receives(sub(0x082A))
    node.serves()
    assert node.receives(sub(0x082A, msg_type=sbn.MsgType.UNSUB)) == []
    node.bus.publish(cfe.emit_telemetry(0x082A), "EDORAS_APP", stamp=True)
    assert node.serves() == []
    assert node.receives(sub(0x08AB, msg_type=sbn.MsgType.UNSUB)) == [
        "SBN 8: cannot process unsubscription from ProcessorID 3, msg 0x08AB not found"
    ]


def test_heartbeats_and_time_outs_count_whole_seconds(node):
    node.receives(sub(0x082A))
    node.serves()
    transcript = []
    for tick in range(0, 14 * SECOND, 200 * MILLISECOND):
        node.cfs.said()
        transcript += [(tick // MILLISECOND, item) for item in [*node.serves(tick), *node.cfs.said()]]
    assert transcript == [
        (6000, ("HEARTBEAT", b"")),
        (11000, "SBN 259: disconnected peer 66:3"),
        (11000, "SBN 5: Disconnected from peer 66:3."),
    ]
    assert node.receives(datagram(sbn.MsgType.HEARTBEAT), 15 * SECOND) == CONNECTED


@pytest.mark.parametrize(
    ("own", "announced"),
    [((0x42, 1), []), ((0x43, 3), []), ((0x43, 1), [11_000, 22_000])],
)
def test_only_a_peer_with_another_spacecraft_and_processor_hears_an_announcement(own, announced):
    node = Node(replace(PROFILE, spacecraft_id=own[0], processor_id=own[1]))
    ticks = range(0, 30 * SECOND, 200 * MILLISECOND)
    assert [tick // MILLISECOND for tick in ticks if node.serves(tick)] == announced


def test_a_disconnect_is_obeyed_and_does_not_connect(node):
    goodbye = datagram(sbn.MsgType.DISCONNECT)
    assert node.receives(goodbye) == []
    node.receives(sub(0x082A))
    assert node.receives(goodbye) == ["SBN 5: Disconnected from peer 66:3."]
    assert not node.peers[BRIDGE].connected


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (sub(0x082A, ident="$Id: another $"), ["SBN 6: version number mismatch with peer CpuID 3", FAILED]),
        (
            datagram(0x07, b"abc"),
            [
                "SBN 10: ERROR: could not process peer message: unknown message type 0x00000007",
                FAILED,
            ],
        ),
        (
            datagram(sbn.MsgType.PROTO, b"\x0b", Peer(0x42, 9)),
            ["SBN 259: ERROR: unknown peer 66:9", NOT_RECEIVED],
        ),
        # Five bytes: the rest of the header and of the message is what the last datagram left.
        (bytes.fromhex("0001030000"), ["SBN 4097: unable to set msgid", FAILED]),
        (
            bytes.fromhex("9000030000000300000042") + bytes(20),
            ["SBN 259: ERROR: could not unpack message", NOT_RECEIVED],
        ),
    ],
)
def test_what_ends_the_receive_task_and_how_it_comes_back(node, data, told):
    node.receives(sub(0x082A))
    node.serves()
    assert (node.receives(data), node.receiving) == (told, False)
    node.serves()
    assert (node.cfs.said(), node.receiving) == ([RESTART], True)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (datagram(sbn.MsgType.NO_MSG), []),
        (datagram(sbn.MsgType.PROTO, b"\x0b"), ["SBN 1: SBN protocol version match with peer 66:3"]),
        (
            datagram(sbn.MsgType.PROTO, b"\x0a"),
            [
                f"SBN 1: ERROR: could not process peer message: {MISMATCH}",
            ],
        ),
        # MsgSz says 500, 20 bytes come: nobody compares.
        (bytes.fromhex("01f40300000003000000421829" + "0000000d0100") + bytes(12), []),
    ],
)
def test_what_does_not_end_it(node, data, told):
    node.receives(sub(0x082A))
    assert (node.receives(data), node.receiving) == (told, True)


@given(st.lists(st.binary(max_size=200) | st.binary(max_size=100).map(lambda rest: datagram(1)[:11] + rest)))
def test_any_bytes_are_survived(datagrams):
    node = Node(replace(PROFILE, event_burst=10_000))
    for index, data in enumerate(datagrams):
        failed = any(text.startswith("SBN 10: ") for text in node.receives(data, index))
        assert node.receiving or failed
        node.serves(index)
    assert all(len(packet) >= cfe.COMMAND_HEADER_BYTES for packet in node.cfs.published)


class PeerMachine(RuleBasedStateMachine):
    """Any order of calls: a peer is connected while it is heard from, and gets what it wants."""

    msg_ids = st.sampled_from([0x082A, 0x082B])

    def __init__(self) -> None:
        super().__init__()
        self.node = Node()
        self.now = 0
        self.heard: int | None = None
        self.wanted: set[int] = set()
        self.due: list[bytes] = []

    def receive(self, data: bytes) -> None:
        self.node.receives(data, self.now)
        self.heard = self.now

    @rule(wanted=msg_ids)
    def subscribes(self, wanted):
        self.receive(sub(wanted))
        self.wanted.add(wanted)

    @rule(wanted=msg_ids)
    def unsubscribes(self, wanted):
        self.receive(sub(wanted, msg_type=sbn.MsgType.UNSUB))
        self.wanted.discard(wanted)

    @rule()
    def says_goodbye(self):
        self.receive(datagram(sbn.MsgType.DISCONNECT))
        self.forget()

    def forget(self) -> None:
        self.heard = None
        self.wanted.clear()
        self.due.clear()

    @rule(wanted=msg_ids)
    def publishes(self, wanted):
        packet = cfe.emit_telemetry(wanted, bytes(8))
        if self.node.bus.publish(packet, "APP", stamp=False).delivered:
            self.due.append(packet)

    @rule(step=st.integers(0, 4 * SECOND))
    def serves(self, step):
        self.now += step
        assert [item for kind, item in self.node.serves(self.now) if kind == "APP"] == self.due
        self.due.clear()
        if self.heard is not None and (self.now - self.heard) // SECOND >= 11:
            self.forget()

    @invariant()
    def it_is_connected_while_heard_from(self):
        state = self.node.peers[BRIDGE]
        assert state.connected == (self.heard is not None)
        assert state.pipe is None or set(state.pipe.limits) == self.wanted


PeerMachine.TestCase.settings = settings(max_examples=examples(60), stateful_step_count=30, deadline=None)
TestPeerMachine = PeerMachine.TestCase
