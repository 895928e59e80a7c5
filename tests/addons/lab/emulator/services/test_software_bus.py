from __future__ import annotations

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from edoras_tools.addons.lab.emulator.messages import whole_packet
from edoras_tools.addons.lab.emulator.services.software_bus import Publication, SoftwareBus
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import ConfigError
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import length_of, msg_id_of


def command(msg_id: int = 0x1827) -> bytes:
    return cfe.emit_command(msg_id, 1)


@pytest.fixture
def bus() -> SoftwareBus:
    return SoftwareBus(SimProfile())


def texts(publication: Publication) -> list[str]:
    return [str(item) for item in publication.events]


def test_the_fifth_of_one_msg_id_is_lost_and_the_event_names_the_culprit(bus):
    pipe = bus.create_pipe("EDORAS_APP_PIPE", 32)
    bus.subscribe(pipe, 0x1827)
    said = [texts(bus.publish(command(), "CI_LAB_APP", stamp=False)) for _ in range(6)]
    error = "CFE_SB 17: Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"
    assert said == [[], [], [], [], [error], [error]]
    assert (bus.counters.msg_limits, bus.counters.pipe_overflows, bus.counters.send_errors) == (2, 0, 2)
    pipe.get()
    assert bus.publish(command(), "CI_LAB_APP", stamp=False).delivered == (pipe,)


def test_a_full_pipe_overflows_before_a_high_limit_is_reached(bus):
    pipe = bus.create_pipe("TO_LAB_TLM_PIPE", 50)
    bus.subscribe(pipe, 0x08F1, 255)
    packet = cfe.emit_telemetry(0x08F1)
    said = [texts(bus.publish(packet, "EDORAS_GEN.EDORAS_GEN_T", stamp=True)) for _ in range(51)]
    error = "CFE_SB 25: Pipe Overflow,MsgId 0x8f1,pipe TO_LAB_TLM_PIPE,sender EDORAS_GEN.EDORAS_GEN_T"
    assert said == [[]] * 50 + [[error]]
    assert bus.counters.pipe_overflows == 1


@pytest.mark.parametrize(
    ("packet", "text", "status"),
    [
        (bytes(76), "CFE_SB 21: Send Err:Invalid MsgId(0x0)in msg,App CI_LAB_APP", -905969661),
        (
            b"\x28\x27" + bytes(74),
            "CFE_SB 21: Send Err:Invalid MsgId(0x2827)in msg,App CI_LAB_APP",
            -905969661,
        ),
        (
            b"\xff\xff" + bytes(74),
            "CFE_SB 21: Send Err:Invalid MsgId(0xffff)in msg,App CI_LAB_APP",
            -905969661,
        ),
        (
            b"\x18\x27\0\0\xff\xff\0\0",
            "CFE_SB 15: Send Err:Msg Too Big MsgId=0x1827,app=CI_LAB_APP,size=65542,MaxSz=32768",
            -905969657,
        ),
        (b"\x18\xee\0\0\0\1\0\0", "CFE_SB 14: No subscribers for MsgId 0x18ee,sender CI_LAB_APP", 0),
    ],
)
def test_what_the_bus_refuses_it_says(bus, packet, text, status):
    publication = bus.publish(packet, "CI_LAB_APP", stamp=False)
    assert (texts(publication), publication.status, publication.delivered) == ([text], status, ())


def test_the_sequence_count_goes_on_only_while_there_is_a_route(bus):
    packet = cfe.emit_telemetry(0x0827)
    counts = [bus.publish(packet, "APP", stamp=True).packet[2:4].hex() for _ in range(2)]
    pipe = bus.create_pipe("P", 1)
    bus.subscribe(pipe, 0x0827, 1)
    # Lost or not: the count is stamped before the pipe refuses.
    counts += [bus.publish(packet, "APP", stamp=True).packet[2:4].hex() for _ in range(3)]
    assert counts == ["c000", "c000", "c001", "c002", "c003"]
    assert bus.publish(packet, "CI_LAB_APP", stamp=False).packet == packet


def test_subscriptions_are_reported_in_order_and_local_ones_are_not(bus):
    pipe = bus.create_pipe("P", 4)
    bus.subscribe(pipe, 0x0827)
    bus.subscribe(pipe, 0x082A, local=True)
    bus.subscribe(pipe, 0x0827)
    assert (bus.subscribed, bus.counters.duplicate_subscriptions) == ([0x0827], 1)
    assert bus.unsubscribe(pipe, 0x0827)
    assert not bus.unsubscribe(pipe, 0x0827)
    assert bus.subscribed == [0x0827]  # cFE does not tell SBN


def test_a_pipe_can_ignore_a_sender(bus):
    pipe = bus.create_pipe("SBN_3_66_Pipe", 4, ignores="SBN")
    bus.subscribe(pipe, 0x1827)
    assert bus.publish(command(), "SBN", stamp=False).delivered == ()
    assert bus.publish(command(), "CI_LAB_APP", stamp=False).delivered == (pipe,)
    bus.delete_pipe(pipe)
    assert bus.publish(command(), "CI_LAB_APP", stamp=False).delivered == ()


def test_a_pipe_is_made_once_and_holds_something(bus):
    bus.create_pipe("P", 1)
    for depth in (1, 0):
        with pytest.raises(ConfigError, match="pipe P"):
            bus.create_pipe("P", depth)


def test_housekeeping_has_the_two_loss_counters_where_ground_reads_them(bus):
    bus.counters.pipe_overflows, bus.counters.msg_limits = 0x1234, 65536 + 7
    packet = cfe.emit_telemetry(0x0803, bus.housekeeping())
    assert (len(packet), packet[28:32].hex()) == (44, "34120700")


@given(st.binary(min_size=8, max_size=64))
def test_any_packet_is_taken_or_refused(data):
    bus = SoftwareBus(SimProfile())
    pipe = bus.create_pipe("P", 2)
    bus.subscribe(pipe, msg_id_of(data))
    publication = bus.publish(data, "APP", stamp=True)
    assert bool(publication.delivered) != bool(publication.events)
    assert len(whole_packet(data)) == length_of(data)


class BusMachine(RuleBasedStateMachine):
    """Any order of calls: no limit is exceeded, and every message is delivered or counted as lost."""

    msg_ids = st.sampled_from([0x0827, 0x0828, 0x1827])
    names = st.sampled_from(["A", "B"])

    def __init__(self) -> None:
        super().__init__()
        self.bus = SoftwareBus(SimProfile())
        self.pipes = {name: self.bus.create_pipe(name, depth) for name, depth in (("A", 3), ("B", 8))}
        self.limits: dict[tuple[str, int], int] = {}
        self.routed: set[int] = set()
        self.expected: dict[str, list[bytes]] = {"A": [], "B": []}
        self.lost = 0

    @rule(name=names, wanted=msg_ids, limit=st.integers(1, 5))
    def subscribe(self, name, wanted, limit):
        self.bus.subscribe(self.pipes[name], wanted, limit)
        self.routed.add(wanted)  # a MsgId that anyone ever subscribed to: only its sequence count goes on
        self.limits.setdefault((name, wanted), limit)

    @rule(name=names, wanted=msg_ids)
    def unsubscribe(self, name, wanted):
        had = self.limits.pop((name, wanted), None)
        assert self.bus.unsubscribe(self.pipes[name], wanted) == (had is not None)

    @rule(wanted=msg_ids, stamp=st.booleans())
    def publish(self, wanted, stamp):
        had_route = wanted in self.routed
        packet = command(wanted) if wanted & 0x1000 else cfe.emit_telemetry(wanted)
        publication = self.bus.publish(packet, "APP", stamp=stamp)
        takers = [name for name in "AB" if (name, wanted) in self.limits]
        for pipe in publication.delivered:
            self.expected[pipe.name].append(publication.packet)
        if had_route:
            assert len(publication.delivered) + len(publication.events) == len(takers)
            self.lost += len(publication.events)
        else:
            assert [item.event_id for item in publication.events] == [14]

    @rule(name=names)
    def receive(self, name):
        want = self.expected[name].pop(0) if self.expected[name] else None
        assert self.pipes[name].get() == want

    @invariant()
    def nothing_exceeds_its_limits(self):
        for name, pipe in self.pipes.items():
            assert len(pipe) == len(self.expected[name]) <= pipe.depth
            for wanted, count in pipe.waiting.items():
                assert count == sum(msg_id_of(item) == wanted for _, item in pipe.messages)
        counters = self.bus.counters
        assert counters.msg_limits + counters.pipe_overflows == counters.send_errors == self.lost


BusMachine.TestCase.settings = settings(max_examples=examples(60), stateful_step_count=40, deadline=None)
TestBusMachine = BusMachine.TestCase
