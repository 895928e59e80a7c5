"""Two captures of the same traffic held against each other."""

from dataclasses import replace

import pytest

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.diagnosis.comparison import compare
from edoras_tools.diagnosis.table import Recorder
from edoras_tools.mission import Mission
from edoras_tools.sessions.profile import MILLISECOND, SECOND
from edoras_tools.sim import Simulation
from edoras_tools.sim.source import frames_of
from edoras_tools.sources.linklayer import Demux

START_NS = 1_800_000_000 * SECOND


@pytest.fixture(scope="module")
def sent():
    return list(Simulation(start_ns=START_NS, command_rate_hz=4.0).run(START_NS + 30 * SECOND))


def rows(sent):
    context = Context()
    recorder = Recorder(context)
    batch = Demux().demux(frames_of(sent))
    recorder.add(batch, ColumnDecoder(context).decode(batch))
    return recorder.rows()


def against(first, second):
    found = compare(rows(first), rows(second), Mission())
    return found, {(item.link.label, item.msg_id): item for item in found.routes}


def commands(sent):
    return [index for index, item in enumerate(sent) if item.destination.port == 1234][2:]


def test_the_same_twice_differs_in_nothing(sent):
    found, routes = against(sent, sent)
    assert (found.lost, found.offset_ns) == (0, 0)
    assert all(item.same == item.first == item.second for item in routes.values())


def test_what_is_missing_is_lost(sent):
    gone = set(commands(sent)[5:9])
    found, routes = against(sent, [item for index, item in enumerate(sent) if index not in gone])
    assert found.lost == routes["ci", 0x1827].lost == 4
    found, routes = against([item for index, item in enumerate(sent) if index not in gone], sent)
    assert found.lost == 0
    assert routes["ci", 0x1827].extra == 4


def test_another_clock_is_no_latency_and_a_late_packet_is(sent):
    late = commands(sent)[7]
    moved = [
        item._replace(time_ns=item.time_ns + 7 * SECOND + (index == late) * 300 * MILLISECOND)
        for index, item in enumerate(sent)
    ]
    found, routes = against(sent, sorted(moved, key=lambda item: item.time_ns))
    assert found.offset_ns == 7 * SECOND
    command = routes["ci", 0x1827]
    assert (command.late, command.lost) == (1, 0)
    assert command.latency.most == 300.0
    assert routes["to", 0x827].latency.most == 0.0


def test_a_changed_packet_with_a_count_is_altered_not_lost(sent):
    at = [index for index, item in enumerate(sent) if item.payload[:2] == b"\x08\x27"][3]
    changed = [
        item._replace(payload=item.payload[:-1] + b"\xff") if index == at else item
        for index, item in enumerate(sent)
    ]
    found, routes = against(sent, changed)
    assert (routes["to", 0x827].altered, found.lost) == (1, 0)


def test_what_the_second_did_not_live_to_see_is_not_lost(sent):
    half = [item for item in sent if item.time_ns < START_NS + 15 * SECOND]
    found, routes = against(sent, half)
    assert found.lost == 0
    assert routes["to", 0x827].first > routes["to", 0x827].second


def test_nothing_in_common(sent):
    up = [item for item in sent if item.destination.port == 1234]
    down = [item for item in sent if item.destination.port == 1235]
    found, routes = against(up, down)
    assert found.offset_ns == 0
    assert routes["ci", 0x1827].same == 0
    assert replace(routes["ci", 0x1827], lost=0).as_json()["latency"] is None
