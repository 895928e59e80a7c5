"""Loss in the emulated cFS: what the doctor says, held to what its software bus really counted."""

import random
from collections import Counter
from contextlib import closing

import pytest
from places import ROOT
from rewriting import datagrams, write

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import ROBOT_PORT
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.units import SECOND


def by_route(diagnosis, rule=""):
    lost = Counter()
    for item in diagnosis.verdicts:
        if rule in item.rule and (item.msg_id is not None or item.rule == "unattributed_loss"):
            lost[item.msg_id] += item.lost or 0
    return lost


@pytest.mark.quick("14.0")
@pytest.mark.parametrize("hertz", [10.0, 14.0, 20.0])
def test_commands_lost_at_the_pipe_are_what_the_counter_says(hertz, lab):
    sent, counters = lab.simulate(hz=hertz, seconds=40, count=int(hertz * 30))
    assert by_route(lab.examine(sent))[0x1827] == pytest.approx(counters.msg_limits, abs=1)


def test_events_that_cfs_stops_after_sixteen_are_no_vanished_telemetry(lab):
    sent, _ = lab.simulate(hz=9.0, seconds=40)
    assert {item.rule for item in lab.examine(sent).verdicts} == {"app_pipe_limit", "event_suppression"}


@pytest.mark.long
def test_commands_lost_beside_much_telemetry_are_seen_in_what_it_does_not_explain(lab):
    sent, counters = lab.simulate("two-rovers", hz=15.0, state_hz=45.0, seconds=50)
    diagnosis = lab.examine(sent)
    at_socket = by_route(diagnosis, "ci_backlog")
    lost = by_route(diagnosis) - at_socket
    telemetry = lost[0x828] + lost[0x829]
    (track,) = diagnosis.case.tracks.values()
    # Which of both commands a count is of nothing tells: most of them are of both together.
    assert lost[0x1827] + lost[0x1828] + lost[None] == track.growth("msg_limits") - telemetry
    (row,) = [row for row in diagnosis.balance if row.among]
    assert ({msg_id for _, msg_id, _ in row.among}, row.all_lost) == ({0x1827, 0x1828}, lost[None])
    shared = {row.msg_id: row.shared for row in diagnosis.balance if row.shared}
    assert set(shared) == {0x1827, 0x1828}
    assert max(shared.values()) <= lost[None] <= sum(shared.values())
    # Before the first 0x803 and after the last one, up to a second each is not in the capture.
    assert track.growth("msg_limits") == pytest.approx(counters.msg_limits, abs=2 * counters.msg_limits / 50)
    assert lost[None] > 50
    alone = lab.examine(lab.simulate("two-rovers", hz=4.0, state_hz=45.0, seconds=50)[0])
    assert {item.rule for item in alone.verdicts} == {"to_message_limit", "event_suppression"}


def test_a_capture_that_begins_after_the_events_stopped_still_names_the_route(lab):
    sent, _ = lab.simulate(hz=10.0, seconds=60)
    late = lab.examine([item for item in sent if item.time_ns > lab.start_ns + 25 * SECOND])
    (verdict,) = [item for item in late.verdicts if item.rule == "app_pipe_limit"]
    assert (verdict.msg_id, verdict.confidence) == (0x1827, "medium")


def test_tos_own_pipe_overflows_and_takes_its_events_with_it(lab):
    sent, counters = lab.simulate(
        generators=((4, 0x8F1, 250), (24, 0x8F1, 0)), limits=((0x8F1, 255), (0x827, 4)), seconds=35, hz=1.0
    )
    assert counters.pipe_overflows > 1000
    diagnosis = lab.examine(sent)
    assert not diagnosis.case.reported_losses or all(
        item.kind != "overflow" for item in diagnosis.case.reported_losses
    )
    assert diagnosis.lost == pytest.approx(counters.pipe_overflows, rel=0.02)
    verdicts = [
        item for item in diagnosis.verdicts if item.rule == "to_pipe_overflow" and item.msg_id == 0x8F1
    ]
    assert sum(item.lost for item in verdicts) == pytest.approx(counters.pipe_overflows, rel=0.15)
    assert any("lost with it" in line for item in diagnosis.verdicts for line in item.evidence)


@pytest.mark.long
def test_steps_over_tos_pipe_are_each_what_was_lost(lab):
    rates = (20, 90, 100, 200, 500, 1000)
    steps = [
        (6 + 11.7 * at + wait, 0x827, hertz)
        for at, rate in enumerate(rates)
        for wait, hertz in ((0, rate), (8, 0))
    ]
    sent, counters = lab.simulate(
        "two-rovers", hz=0.0, state_hz=0.0, seconds=80, generators=tuple(steps), limits=((0x827, 255),)
    )
    diagnosis = lab.examine(sent)
    found = [item for item in diagnosis.verdicts if (item.rule, item.msg_id) == ("to_pipe_overflow", 0x827)]
    offered = sorted(round((item.of - 1) / ((item.end_ns - item.start_ns) / 1e9), -1) for item in found)
    assert offered == [90, 100, 200, 500, 1000]
    total = sum(item.lost for item in diagnosis.case.losses)
    assert total == pytest.approx(counters.pipe_overflows, rel=0.02)
    for item in found:
        # Of 100 a second some are housekeeping and events.
        assert (item.of - item.lost) / 8 == pytest.approx(96, abs=10)


@pytest.mark.quick("60")
@pytest.mark.parametrize("rate", [60, 100, 300])
def test_a_burst_between_slow_messages_of_one_msg_id_is_counted_once(rate, lab):
    sent, counters = lab.simulate(
        hz=2.0, state_hz=0.0, seconds=18, generators=((5, 0x827, rate), (11, 0x827, 0)), limits=((0x827, 4),)
    )
    assert lab.examine(sent).lost == counters.msg_limits


@pytest.mark.quick("6")
@pytest.mark.parametrize("seconds", [6, 9, 12])
def test_what_the_full_pipe_of_two_arms_lost_is_counted_once(seconds, lab):
    sent, counters = lab.simulate(
        "two-arms",
        hz=0.0,
        state_hz=2.0,
        seconds=12 + seconds,
        generators=((5, 0x827, 100), (5 + seconds, 0x827, 0)),
        limits=((0x827, 64),),
    )
    assert lab.examine(sent).lost == counters.pipe_overflows


@pytest.mark.long
def test_two_instances_of_one_boot_time_are_told_apart(lab):
    first = Simulation(scenario="rover", command_rate_hz=10.0, start_ns=lab.start_ns)
    second = Simulation(
        SimProfile(processor_id=2, to_source_port=50002, ci_port=1236, sbn_port=2235),
        "arm",
        command_rate_hz=4.0,
        start_ns=lab.start_ns + SECOND // 2,
    )
    end_ns = lab.start_ns + 40 * SECOND
    sent = lab.merged(list(first.run(end_ns)), *second.run(end_ns))
    diagnosis = lab.examine(sent)
    assert sorted(item.name for item in diagnosis.case.instances.items) == ["66:1", "66:2"]
    (verdict,) = [item for item in diagnosis.verdicts if item.lost]
    assert verdict.rule == "app_pipe_limit"
    assert verdict.lost == pytest.approx(first.cfs.bus.counters.msg_limits, abs=4)


def test_a_table_with_other_limits_is_measured(lab):
    sent, counters = lab.simulate(
        generators=((4, 0x8F1, 60), (24, 0x8F1, 0)), limits=((0x8F1, 10),), seconds=30, hz=1.0
    )
    (verdict,) = [item for item in lab.examine(sent).verdicts if item.rule == "to_message_limit"]
    assert verdict.lost == pytest.approx(counters.msg_limits, rel=0.02)
    assert "TO keeps 10 of this MsgId" in verdict.reason
    assert "20 a second get through" in verdict.reason


@pytest.mark.long
@pytest.mark.parametrize("configured", [True, False])
def test_two_routes_share_the_counter_and_telemetry_keeps_its_own(configured, lab):
    sent, counters = lab.simulate("two-arms", hz=10.0, state_hz=10.0, seconds=60)
    diagnosis = lab.examine(sent, lab.missions("two-arms") if configured else ())
    lost = by_route(diagnosis)
    assert lost[0x828] == pytest.approx(117, abs=3)
    assert lost[0x829] == pytest.approx(117, abs=3)
    assert lost[0x1827] + lost[0x1828] + lost[None] == pytest.approx(counters.msg_limits - 234, abs=8)


@pytest.mark.long
def test_the_same_message_is_found_under_its_other_msg_id(lab):
    sent, _ = lab.simulate("two-rovers", seconds=40, hz=2.0)
    diagnosis = lab.examine(sent, lab.missions("two-rovers"))
    crossings = {
        row["msg_id"]: item["from"]
        for row in diagnosis.routes
        for item in row["crossings"]
        if item["matched"] > 20
    }
    assert crossings == {"0x082a": "0x1827", "0x082b": "0x1828", "0x0828": "0x1829", "0x0829": "0x182a"}
    delays = [
        item["latency"] for row in diagnosis.routes for item in row["crossings"] if row["msg_id"] == "0x0828"
    ]
    assert 0 < delays[0]["p50_ms"] < delays[0]["max_ms"] < 520


@pytest.mark.each(3)
@pytest.mark.parametrize("keep", [CI, TO, SBN])
def test_a_capture_of_one_link_is_modest(keep, lab):
    ports = {CI: {1234}, TO: {1235}, SBN: {2234, 2235, 2236}}[keep]
    sent, _ = lab.simulate("two-rovers", seconds=30, hz=4.0)
    diagnosis = lab.examine(
        [item for item in sent if item.destination.port in ports], lab.missions("two-rovers")
    )
    assert diagnosis.lost == 0
    assert any(
        any(text in item.reason for text in ("cannot be shown", "cannot show", "is here to show"))
        for item in diagnosis.verdicts
    )


def test_the_captures_own_drops_come_before_blame(lab):
    sent, _ = lab.simulate(seconds=60)
    kept = [item for index, item in enumerate(sent) if index % 17]
    diagnosis = lab.examine(kept, drops=len(sent) - len(kept))
    # What CI counted beyond the capture is no loss.
    assert {item.rule for item in diagnosis.verdicts} == {"capture_drops", "lost_before_ci", "perhaps_lost"}
    assert (diagnosis.lost, diagnosis.unaccounted) == (0, 0)
    assert diagnosis.uncertain > 20


def test_more_than_the_capture_dropped_was_lost(lab, msg_id):
    sent, _ = lab.simulate(seconds=60)
    kept = [item for item in sent if not (msg_id(item) == 0x827 and item.time_ns % 7 < 4)]
    diagnosis = lab.examine(kept, drops=2)
    blamed = [item for item in diagnosis.verdicts if item.rule == "lost_after_cfs"]
    assert blamed
    for blame in blamed:
        assert blame.confidence == "low"
        assert any("the capture itself lost 2 frames" in line for line in blame.evidence)
    gone = len(sent) - len(kept)
    assert gone - 2 <= diagnosis.lost + diagnosis.unaccounted <= gone
    assert diagnosis.lost + diagnosis.unaccounted + diagnosis.uncertain == gone


@pytest.mark.each(2)
@pytest.mark.parametrize("by", [45, -20])
def test_a_clock_that_jumps_changes_no_count(by, lab):
    sent, counters = lab.simulate(hz=10.0, seconds=40, count=300)
    half = len(sent) // 2
    jumped = [
        item._replace(time_ns=item.time_ns + by * SECOND * (index >= half)) for index, item in enumerate(sent)
    ]
    diagnosis = lab.examine(jumped)
    assert by_route(diagnosis)[0x1827] == pytest.approx(counters.msg_limits, abs=1)
    assert {item.rule for item in diagnosis.verdicts} == {"app_pipe_limit", "clock_jump", "event_suppression"}


@pytest.mark.long
def test_chapters_add_up(lab, monkeypatch):
    from edoras_tools.diagnosis import examination

    sent, counters = lab.simulate(hz=10.0, seconds=60)
    monkeypatch.setattr(examination, "CHAPTER", 700)
    diagnosis = lab.examine(sent)
    assert diagnosis.datagrams == len(sent)
    assert by_route(diagnosis)[0x1827] == pytest.approx(counters.msg_limits, abs=12)
    assert sum(item.rule == "older_losses" for item in diagnosis.verdicts) == 0


def test_crossings_of_chapters_add_up():
    from edoras_tools.diagnosis.examination import _ROUTE

    counts = {"of": 5, "matched": 4, "superseded": 1, "missing": 0}
    slow, fast = {"count": 4, "p99_ms": 9.0}, {"count": 4, "p99_ms": 2.0}
    one = {"from": "0x1827", "from_link": "ci", **counts, "latency": slow}
    other = {**one, "from": "0x1828", "latency": None}
    later = [{**one, "latency": fast}, {**other, "latency": fast}]
    (first, second) = _ROUTE["crossings"]([one, other], later)
    assert first == {**one, **{name: 2 * value for name, value in counts.items()}}
    assert (second["latency"], second["of"]) == (fast, 10)


@pytest.mark.long
@pytest.mark.parametrize(("chapter", "sorted_"), [(700, True), (100, False)])
def test_a_long_capture_that_is_shuffled_as_a_whole_is_sorted_or_said_first(
    tmp_path, monkeypatch, chapter, sorted_
):
    from edoras_tools.diagnosis import examination

    monkeypatch.setattr(examination, "CHAPTER", chapter)
    traffic = datagrams(ROOT / "tests/captures/a_rover.pcap.zst")
    path = write(tmp_path / "x.pcap", random.Random(5).sample(traffic, len(traffic)))
    decoder = ColumnDecoder(Context())
    examined = examination.Examination(decoder.context)
    with closing(open_file(path)) as source:
        for batch in source.batches():
            for at in range(0, len(batch), 90):
                part = batch.take(slice(at, at + 90))
                examined.add(part, decoder.decode(part))
    found = examined.diagnose()
    first = found.verdicts[0]
    assert first.rule == "out_of_order"
    assert ("not right" in first.reason) != sorted_
    assert found.bad
    if sorted_:
        assert (found.lost, found.unaccounted) == (92, 0)


def test_another_cfs_has_other_constants(lab):
    profile = SimProfile(app_msg_limit=8)
    sent, _ = lab.simulate(hz=10.0, seconds=20, app_msg_limit=8)
    only = [item for item in sent if item.destination.port == 1234]
    rules = [item.rule for item in lab.examine(only, profile=profile).verdicts]
    assert "rate_over_limit" not in rules
    assert "rate_over_limit" in [item.rule for item in lab.examine(only).verdicts]


@pytest.mark.each(2)
@pytest.mark.quick("False")
@pytest.mark.parametrize("configured", [True, False])
def test_memory_overrun_by_one_message_takes_the_next_telemetry_away(configured, lab, msg_id):
    sent, _ = lab.simulate("two-rovers", seconds=45, hz=2.0)
    when_ns = lab.start_ns + 20 * SECOND
    spoilt, done = [], False
    for item in sent:
        if item.destination.port == 1235 and item.time_ns > when_ns:
            if msg_id(item) == 0x829:
                continue
            if msg_id(item) == 0x828 and not done:
                # What a longer frame_id does: the envelope claims what the fixed packet cannot hold.
                data, done = bytearray(item.payload), True
                data[16:24] = data[24:32] = (126).to_bytes(8, "little")
                spoilt.append(item._replace(payload=bytes(data)))
                continue
        spoilt.append(item)
    diagnosis = lab.examine(spoilt, lab.missions("two-rovers") if configured else ())
    told = {item.rule: item for item in diagnosis.verdicts}
    assert (told["struct_overrun"].msg_id, told["struct_overrun"].lost) == (0x828, 1)
    vanished = told["topic_silent"]
    assert (vanished.msg_id, vanished.severity.label) == (0x829, "warning")
    assert "overran its struct" in vanished.reason
    assert vanished.lost is None
    assert diagnosis.lost == 1


def _hole(index, item, start_ns):
    return 20 * SECOND < item.time_ns - start_ns < 22 * SECOND


def _each_seventh(index, item, start_ns):
    return index % 7 == 0


@pytest.mark.parametrize("gone", [_hole, _each_seventh])
def test_a_counter_that_others_raise_is_not_taken_for_what_the_network_lost(gone, lab):
    sent, counters = lab.simulate(hz=10.0, seconds=60)
    kept = [item for index, item in enumerate(sent) if not gone(index, item, lab.start_ns)]
    diagnosis = lab.examine(kept)
    lost = Counter()
    for item in diagnosis.verdicts:
        lost[item.rule] += item.lost or 0
    quiet = {"event_suppression", "older_losses", "lost_before_ci"}
    if gone is _hole:
        # Nothing at all is there: the capture missed it, and no network lost it.
        assert set(lost) - quiet == {"app_pipe_limit", "not_examined"}
        assert lost["app_pipe_limit"] <= counters.msg_limits
        return
    assert set(lost) - quiet == {"app_pipe_limit", "lost_after_cfs"}
    assert not lost["lost_before_ci"]  # CI counted more than is left of the capture
    assert lost["app_pipe_limit"] == pytest.approx(counters.msg_limits, abs=3)
    assert lost["lost_after_cfs"] > 5
    assert {item.confidence for item in diagnosis.verdicts if item.rule == "lost_after_cfs"} == {"medium"}


def test_gaps_in_slow_telemetry_are_not_a_full_pipes_where_another_pipe_is_full(lab, msg_id):
    sent, counters = lab.simulate(hz=10.0, seconds=40, app_pipe_depth=4, app_msg_limit=40)
    assert counters.pipe_overflows > 20
    pose = [
        index for index, item in enumerate(sent) if item.destination.port == 1235 and msg_id(item) == 0x800
    ]
    diagnosis = lab.examine([item for index, item in enumerate(sent) if index not in {pose[9], pose[17]}])
    (after,) = [item for item in diagnosis.verdicts if item.msg_id == 0x800]
    assert (after.rule, after.lost) == ("lost_after_cfs", 2)


def test_spans_of_one_pipe_count_each_loss_once(lab, msg_id):
    sent, counters = lab.simulate(hz=10.0, seconds=60)
    quiet = [(9, 12), (21, 24), (24.5, 27.5), (40, 43)]
    kept = [
        item
        for item in sent
        if item.destination.port != 1234
        or not any(low < (item.time_ns - lab.start_ns) / SECOND < high for low, high in quiet)
    ]
    verdicts = [item for item in lab.examine(kept).verdicts if item.rule == "app_pipe_limit"]
    assert len(verdicts) > 2
    assert sum(item.lost for item in verdicts) <= counters.msg_limits


def test_what_the_robots_side_lacks_at_two_hertz_did_not_give_way_to_a_newer_one(lab, tmp_path):
    sent = datagrams(ROOT / "tests/captures/b_arm_single.pcap.zst")
    to_robot = [at for at, item in enumerate(sent) if item.destination[1] == ROBOT_PORT]
    lacking = set(to_robot[5:-5:9])
    path = write(tmp_path / "lacks.pcap", [item for at, item in enumerate(sent) if at not in lacking])
    diagnosis = lab.read(path)
    (verdict,) = [item for item in diagnosis.verdicts if item.rule == "crossing_loss"]
    assert verdict.reason.startswith(f"{len(lacking)} of 120 messages")
    assert sum(row.superseded for row in diagnosis.balance) == 0
