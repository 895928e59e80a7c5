"""What became of a step's messages, from datagrams made up for it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import MISSIONS

from edoras_tools.addons.lab.sweep.plan import Mark, Observer, route_of
from edoras_tools.addons.lab.sweep.run import Judge
from edoras_tools.cfs import software_bus
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.links.bare import TO
from edoras_tools.links.sbn import SBN
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

COMMAND, TELEMETRY = 0x1827, 0x0827
BOOT_S = 1000


@pytest.fixture(scope="module")
def bench():
    return Settings([MISSIONS / "rover_ground.yaml"]).workbench()


class Step:
    """A step of ten seconds: housekeeping once a second, and what a test adds."""

    def __init__(self, bench, msg_id):
        route = route_of(hex(msg_id), None, bench.mission)
        self.observer = Observer(bench, route)
        self.judge = Judge(route, SimProfile(), measures=False)
        self._items = []
        self.observer.quiet(0)

    def telemetry(self, msg_id, at_s, payload=b"", count=0):
        packet = cfe.emit_telemetry(msg_id, payload, seconds=BOOT_S + int(at_s), sequence_count=count)
        self._items.append((at_s, lambda now: self.observer.received(TO, packet, now)))

    def bus(self, at_s, *, limits=0, overflows=0):
        values = dict.fromkeys(cfe.SOFTWARE_BUS_HOUSEKEEPING.by_name, 0)
        values |= {"pipe_overflow_error_counter": overflows, "message_limit_error_counter": limits}
        self.telemetry(0x803, at_s, cfe.SOFTWARE_BUS_HOUSEKEEPING.emit(values), count=int(at_s))

    def event(self, at_s, event_id, **values):
        fields = dict.fromkeys(cfe.EVENT.by_name, 0) | {
            "app_name": "CFE_SB",
            "event_id": event_id,
            "event_type": 3,
            "spacecraft_id": 66,
            "processor_id": 1,
            "message": software_bus.EVENTS[event_id].text.format(**values),
        }
        self.telemetry(0x808, at_s, cfe.EVENT.emit(fields))

    def commands(self, count, hz=12):
        packet = cfe.emit_command(COMMAND, 1)
        for index in range(count):
            self._items.append((1 + index / hz, lambda now: self.observer.sent(packet, now)))

    def take(self):
        before = self.observer.mark()
        for at_s, take in sorted(self._items, key=lambda item: item[0]):
            take(int(at_s * SECOND))
        return before, self.observer.mark()


OURS = {"msg_id": COMMAND, "pipe": "EDORAS_APP_PIPE", "sender": "CI_LAB_APP"}
OTHER = {"msg_id": 0x828, "pipe": "TO_LAB_TLM_PIPE", "sender": "EDORAS_APP"}


@pytest.mark.parametrize(
    ("grown", "named", "lost", "hop"),
    [
        (0, [], 0, ""),
        (5, [OURS] * 5, 5, "EDORAS_APP_PIPE"),
        (40, [OURS] * 16, 40, "EDORAS_APP_PIPE"),  # events stop after 16
        (30, [], 30, "application pipe"),  # no event: the commands came too fast
        (5, [], 5, "software bus"),  # of 12 Hz a pipe of 4 loses 33: it is not that
        (5, [OTHER] * 5, 0, ""),
    ],
)
def test_whose_loss_it_is(bench, grown, named, lost, hop):
    step = Step(bench, COMMAND)
    for second in range(12):
        step.bus(second, limits=grown if second >= 4 else 0)
    for index, values in enumerate(named):
        step.event(2 + index / 100, software_bus.MSG_LIMIT, **values)
    step.commands(100)
    before, after = step.take()
    found = step.judge.commands(step.observer, before, after, sent=100, rate_hz=12)
    assert (found.sent, found.lost, found.delivered, found.hop) == (100, lost, 100 - lost, hop)
    assert bool(found.others) == (OTHER in named)


def test_what_ingest_never_read_is_lost_in_its_socket(bench):
    step = Step(bench, COMMAND)
    for second in range(24):
        step.bus(second)
        read = 7 + min(382, 22 * max(0, second - 1))  # 11 each half second, until its socket is empty
        step.telemetry(0x884, second, bytes(12) + read.to_bytes(4, "little") + bytes(8), count=second)
    step.commands(400, hz=400)
    before, after = step.take()
    found = step.judge.commands(step.observer, before, after, sent=400, rate_hz=400)
    assert (found.lost, found.not_ingested, found.hop) == (18, 18, "CI_LAB_APP socket")


def test_telemetry_that_vanishes_without_a_trace_is_lost_too(bench):
    step = Step(bench, TELEMETRY)
    for second in range(10):
        step.bus(second)
        step.telemetry(TELEMETRY, second + 0.5, count=second)
    before, after = step.take()
    found = step.judge.telemetry(step.observer, before, after, least=70, requested=80)
    assert (found.sent, found.lost, found.unseen, found.hop) == (80, 70, 70, "unknown")


def test_gaps_that_cfs_did_not_count_were_lost_behind_it(bench):
    step = Step(bench, TELEMETRY)
    for second in range(14):
        step.bus(second)
        if second not in {5, 6, 8, 9}:
            step.telemetry(TELEMETRY, second + 0.5, count=second)
    before, after = step.take()
    found = step.judge.telemetry(step.observer, before, after)
    assert (found.sent, found.lost, found.gaps, found.bus) == (14, 4, 4, 0)
    assert found.hop == "between cFS and the capture"


def test_a_step_that_goes_on_knows_the_last_message_of_the_one_before(bench):
    step = Step(bench, TELEMETRY)
    for second in range(14):
        step.bus(second)
        step.telemetry(TELEMETRY, second + 0.5, count=second)
    step.take()
    step.observer.go_on(14 * SECOND)
    again = Step(bench, TELEMETRY)
    again.observer = step.observer
    for second in range(14, 24):
        again.bus(second)
        if second != 14:
            again.telemetry(TELEMETRY, second + 0.5, count=second)
    before, after = again.take()
    found = again.judge.telemetry(again.observer, before, after)
    assert (found.delivered, found.lost) == (9, 1)


@given(st.sampled_from([TO, SBN]), st.lists(st.binary(max_size=250), max_size=5), st.booleans())
def test_any_bytes_may_come(bench, link, datagrams, headed):
    observer = Observer(bench, route_of("0x0827", None, bench.mission))
    observer.expected = b"\x08\x27"
    for now, data in enumerate(datagrams):
        for msg_id in (0x803, 0x808, 0x884, TELEMETRY) if headed else (None,):
            observer.received(link, (msg_id.to_bytes(2, "big") if msg_id else b"") + data, now)
    observer.sent(b"", len(datagrams))
    found = Judge(route_of("0x0827", None, bench.mission), SimProfile(), measures=False).telemetry(
        observer, Mark(), observer.mark()
    )
    assert found.lost >= 0
