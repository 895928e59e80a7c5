"""Two captures of the same traffic held against each other."""

from contextlib import closing

import pytest
from merging import merge
from msgspec.structs import replace
from places import CAPTURES, MISSIONS, ROOT

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.runs.comparison import compare_captures
from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.links.bare import CI
from edoras_tools.mission import Mission
from edoras_tools.model import Endpoint
from edoras_tools.units import MILLISECOND, SECOND

GROUND = Endpoint("127.0.0.2", 40000)
SEASON = ROOT / "tests/captures/season3"
START_NS = 1_800_000_000 * SECOND


@pytest.fixture(scope="module")
def sent():
    run = Simulation(start_ns=START_NS, command_rate_hz=4.0).run(START_NS + 30 * SECOND)
    return [item._replace(source=GROUND) if item.destination.port == 1234 else item for item in run]


def recorded(sent):
    context = Context()
    recorder = Recorder(context)
    batch = Demux().demux(frames_of(sent))
    recorder.add(batch, ColumnDecoder(context).decode(batch))
    return recorder


def against(first, second):
    found = compare_captures(recorded(first), recorded(second), Mission())
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


def apart(sent):
    """The same as captured at cFS, 5 ms away, by a clock that is 2 s ahead."""
    to_cfs = 5 * MILLISECOND
    moved = [
        item._replace(
            time_ns=item.time_ns + 2 * SECOND + (to_cfs if item.destination.port == 1234 else -to_cfs)
        )
        for item in sent
    ]
    return sorted(moved, key=lambda item: item.time_ns)


def test_what_is_missing_on_the_way_back_is_lost_too(sent):
    telemetry = [index for index, item in enumerate(sent) if item.payload[:2] == b"\x08\x27"]
    gone = {*commands(sent)[5:9], *telemetry[8:10]}
    ground = [item for index, item in enumerate(sent) if index not in telemetry[8:10]]
    cfs = apart([item for index, item in enumerate(sent) if index not in commands(sent)[5:9]])
    for first, second, turned in ((ground, cfs, False), (cfs, ground, True)):
        found, routes = against(first, second)
        assert abs(abs(found.offset_ns) - 2 * SECOND) <= 5 * MILLISECOND
        up, down = routes["ci", 0x1827], routes["to", 0x827]
        assert (up.lost, up.extra, up.back) == (4, 0, turned)
        assert (down.lost, down.extra, down.back) == (2, 0, not turned)
        assert found.lost == len(gone)
        assert sum(item.neither for item in found.routes) == 0


def test_doubles_are_doubles_and_what_neither_has_was_lost_before(sent):
    telemetry = [index for index, item in enumerate(sent) if item.payload[:2] == b"\x08\x27"]
    kept = [item for index, item in enumerate(sent) if index not in telemetry[4:7]]
    again = [copy for item in kept for copy in [item] * (1 + (item is sent[telemetry[8]]))]
    found, routes = against(apart(again), kept)
    down = routes["to", 0x827]
    assert (down.doubled, down.extra, down.lost, down.neither) == (0, 0, 0, 3)
    found, routes = against(apart(kept), again)
    down = routes["to", 0x827]
    assert (down.doubled, down.extra, down.lost, down.neither) == (1, 0, 0, 3)
    assert found.lost == 0


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
    assert found.common


def test_copies_of_a_relay_are_doubled_and_its_way_back_goes_back():
    """Its truth: 14 dropped, 78 doubled, 26 late; one telemetry packet came 0.17 s late by itself."""
    context = Context(options=Options(ports=((CI, 5234),)))
    sides = []
    for side in ("ground", "cfs"):
        recorder = Recorder(context)
        decoder = ColumnDecoder(context)
        with closing(open_file(SEASON / f"q07_uplink_dup_loss_reorder_{side}.pcap.zst")) as source:
            for batch in source.batches():
                recorder.add(batch, decoder.decode(batch))
        sides.append(recorder)
    found = compare_captures(*sides, Mission())
    routes = {item.msg_id: item for item in found.routes}
    up = routes[0x1827]
    assert (up.lost, up.doubled, up.late, up.extra, up.back) == (14, 78, 26, 0, False)
    assert (found.offset_ns, routes[0x880].back, routes[0x880].late) == (0, True, 1)


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
    assert (found.offset_ns, found.common) == (0, False)
    assert routes["ci", 0x1827].same == 0
    assert replace(routes["ci", 0x1827], lost=0).as_json()["latency"] is None


def test_each_spacecraft_is_held_against_itself(call, tmp_path):
    """Both have the same MsgIds; the second capture has only the second of them."""
    captures = {"10.0.0.2": CAPTURES / "b_arm_single.pcap", "10.0.0.3": CAPTURES / "a_rover.pcap"}
    whole, (_, second) = merge(captures, tmp_path)
    words = ("doctor", whole, "--against", second, "--json")
    rows = call(*words).json()["routes"]
    counts = {(row["spacecraft"], row["msg_id"]): (row["first"], row["same"], row["lost"]) for row in rows}
    assert counts[2, "0x1827"] == (600, 600, 0)
    assert counts[2, "0x0827"] == (63, 63, 0)
    assert all(same == lost == 0 for (number, _), (_, same, lost) in counts.items() if number == 1)
    chosen = call(*words, "--topic", "/sc_2/cmd_vel", "-c", MISSIONS / "rover_ground.yaml").json()["routes"]
    assert [(row["topic"], row["spacecraft"]) for row in chosen] == [("/sc_2/cmd_vel", 2)]
