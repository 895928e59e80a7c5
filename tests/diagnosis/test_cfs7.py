"""What the doctor says of captures of cFS 7, held to what was sent and what arrived."""

from collections import Counter
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
import truth
from msgspec.structs import replace
from places import ROOT
from rewriting import datagrams, write

from edoras_tools.decode import Options
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings
from tests.support.balance import arrived, ended

FOLDER = ROOT / "tests/captures/cfs7"


PORTS = {"relay": ("--port", "ci:5234")}
TOGETHER = "diagnoses"


def examined(name):
    return truth.examined(FOLDER / f"{name}.pcap.zst", PORTS.get(name, ()))


def examine(path, options):
    bench = Settings(options=options).workbench()
    examination = Examination(bench.columns.context)
    with closing(open_file(path)) as source:
        for batch in source.batches():
            examination.add(batch, bench.columns.decode(batch))
    return examination.diagnose()


def found(diagnosis, rule):
    return [item for item in diagnosis.verdicts if item.rule == rule]


def chain(diagnosis, msg_id):
    (item,) = [item for item in diagnosis.chains if item.as_json()["msg_id"] == msg_id]
    return {hop["hop"]: hop for hop in item.as_json()["hops"]}


def test_every_command_that_ci_or_cfs_did_not_hear_is_told_there():
    diagnosis = examined("boots")
    (outage,) = found(diagnosis, "app_outage")
    assert (outage.lost, outage.of, outage.hop) == (26, 26, "CI_LAB_APP")
    (restart,) = found(diagnosis, "cfs_restart")
    assert restart.reason.endswith(": 8 commands sent from 19.0 s to 20.4 s reached nobody")
    assert not found(diagnosis, "app_pipe_limit")
    hops = chain(diagnosis, "0x1827")
    assert (hops["CI"]["lost"], hops["software bus"]["lost"]) == (34, 0)
    assert (hops["application to robot"]["out"], hops["application to robot"]["unaccounted"]) == (183, 18)


def test_telemetry_that_ends_is_told_and_what_was_sent_since_is_blamed_on_nobody():
    diagnosis = examined("boots")
    (ended,) = found(diagnosis, "to_stopped")
    assert ended.reason.startswith("Telemetry Output sends nothing from 34.1 s to the end, 14.0 s")
    assert ended.evidence[0] == "65 datagrams to CI since then"
    (crossing,) = found(diagnosis, "crossing_loss")
    assert any(
        line.startswith("18 of them were sent after the last count of CI") for line in crossing.evidence
    )
    assert not any("explain no more" in line for line in crossing.evidence)


def test_a_restart_in_frames_that_were_cut_is_told_though_nothing_names_its_cfs(tmp_path):
    cut = write(tmp_path / "cut.pcap", datagrams(FOLDER / "boots.pcap.zst"), snap=96)
    diagnosis = examine(cut, Options())
    (restart,) = found(diagnosis, "cfs_restart")
    # Three more were sent between its last sign and the next one that was due: it may have read them. And
    # two just after CI was told to restart, which it may not have.
    assert (restart.lost, restart.reason[:28]) == (5, "cFS restarted between 18.6 s")
    assert diagnosis.uncertain == 5
    assert sum(item.lost or 0 for item in diagnosis.verdicts) == diagnosis.lost


def test_what_is_sent_to_a_ci_that_was_stopped_is_lost_there():
    diagnosis = examined("apps_stopped")
    lost = {
        (item.hop, item.cause): (item.lost, item.of) for item in found(diagnosis, "app_outage") if item.lost
    }
    assert lost == {
        ("EDORAS_APP", "stopped"): (143, 143),  # the command to start it was too short
        ("CI_LAB_APP", "ci_stopped"): (36, 36),
    }
    hops = chain(diagnosis, "0x1827")
    assert (hops["CI"]["lost"], hops["application to robot"]["out"]) == (36, 31)
    assert hops["application to robot"]["waiting"] == 0


def test_what_a_relay_doubled_and_lost_is_not_laid_on_the_application_alone():
    diagnosis = examined("relay")
    (verdict,) = [item for item in found(diagnosis, "lost_before_ci") if item.lost]
    assert "on 0x1827 lost at network before CI" in verdict.reason
    assert verdict.evidence[0].startswith("CI read 216, of which 215 came out of the application")
    # One of those that it read did not come out: the command that enabled Telemetry Output, or a Twist.
    assert (verdict.lost, diagnosis.lost, diagnosis.unaccounted, diagnosis.uncertain) == (10, 10, 0, 1)


def test_an_application_that_reads_late_is_not_told_to_be_sent_less():
    diagnosis = examined("slow_app")
    verdicts = found(diagnosis, "app_pipe_limit")
    shared = found(diagnosis, "unattributed_loss")  # of two commands together
    assert sum(item.lost for item in (*verdicts, *shared)) == diagnosis.lost == 48
    for item in verdicts:
        assert any(line.endswith("at most 2 within 500 ms") for line in item.evidence)
        assert item.remedy.startswith("see what keeps the application's task from its pipe")


@pytest.mark.parametrize("packet", [340, 412, 484, 847])
def test_what_ci_dropped_for_its_length_is_told_as_that(packet):
    (verdict,) = [
        item
        for item in found(examined("bad_commands"), "bad_command")
        if f"packet {packet}: packet data length disagrees with the datagram; CI drops it" in item.reason
    ]
    assert (verdict.lost, verdict.hop, verdict.confidence) == (1, "CI_LAB_APP", "high")


def test_what_a_peer_unsubscribed_is_not_lost():
    diagnosis = examined("sbn_peer")
    assert not found(diagnosis, "lost_after_cfs")
    (row,) = [row for row in diagnosis.routes if row["msg_id"] == "0x082a"]
    assert row["lost"] == 42  # while the peer was silent


def test_what_an_unknown_peer_sent_is_lost_once():
    diagnosis = examined("sbn_peer")
    (verdict,) = found(diagnosis, "unknown_peer")
    (row,) = [row for row in diagnosis.balance if row.lost.get("unknown_peer")]
    assert (verdict.lost, verdict.msg_id, row.msg_id, row.came, row.out) == (1, 0x1829, 0x1829, 1, 0)


def test_commands_that_came_out_and_were_lost_behind_that_leave_the_pipes_losses_to_their_own_time():
    diagnosis = examined("sbn_rates")
    verdicts = sorted(found(diagnosis, "app_pipe_limit"), key=lambda item: item.start_ns)
    assert [item.lost for item in verdicts] == [63, 123]
    assert Counter(item.rule for item in diagnosis.verdicts if item.lost) == {
        "to_message_limit": 2,
        "app_pipe_limit": 2,
    }
    assert diagnosis.lost == 2027 + 63 + 123


def test_two_cfs_that_started_together_on_one_host_are_two_and_lost_what_the_counter_says():
    diagnosis = examined("two_tcp")
    first, *_ = diagnosis.case.tracks.values()
    counted = first.growth("msg_limits")
    over_limits = [item for item in diagnosis.case.losses if item.kind == "limit"]
    assert sum(item.lost for item in over_limits if item.instance == 0) == counted == 2635
    # The second one's counter is not in the capture; its peer's pipe was emptied in full rounds.
    assert sum(item.lost for item in over_limits if item.instance == 1) == 161 + 888
    (restart,) = found(diagnosis, "cfs_restart")
    assert restart.reason.startswith("cFS 66:2 restarted between 32.2 s and 45.6 s")
    assert all(arrived(line) is None or arrived(line) <= line.sent for line in diagnosis.headlines)


def test_a_topic_that_goes_on_over_a_new_tcp_connection_is_not_silent_to_the_end():
    told = [item for item in found(examined("two_tcp"), "topic_silent") if "0x0827" in item.reason]
    assert [("for 14.0 s" in item.reason, "no more" in item.reason) for item in told] == [(True, False)]


def test_counters_that_were_set_to_0_by_command_are_no_restart():
    diagnosis = examined("counters_reset")
    assert not found(diagnosis, "app_outage")
    # One was counted, and its count set to 0, between two 0x803.
    assert diagnosis.lost == sum(item.lost for item in found(diagnosis, "app_pipe_limit")) == 17
    hops = chain(diagnosis, "0x1827")
    assert (hops["CI"]["lost"], hops["application to robot"]["out"]) == (0, 202)


def test_a_processor_reset_is_a_restart_though_the_clock_goes_on():
    diagnosis = examined("processor_reset")
    (restart,) = found(diagnosis, "cfs_restart")
    assert restart.reason.startswith("cFS 66:1 restarted between 9.0 s and 18.1 s: 13 commands sent ")
    assert restart.reason.endswith("from 10.0 s to 12.4 s reached nobody")
    assert "packet 156: the processor was told to restart" in restart.evidence
    assert not found(diagnosis, "clock_jump")
    assert not found(diagnosis, "app_outage")
    assert chain(diagnosis, "0x1827")["CI"]["lost"] == restart.lost == 13
    assert sum(row.not_captured for row in diagnosis.balance) == 0
    assert diagnosis.lost == 13


def test_two_processor_resets_are_told_one_by_one(tmp_path):
    first = datagrams(FOLDER / "processor_reset.pcap.zst")
    period = (first[-1].time_ns - first[0].time_ns) // 10**9 + 1

    def later(item):
        payload, (address, port) = item.payload, item.source
        if not payload[0] & 0x10:  # telemetry: its clock goes on, and Telemetry Output has a new port
            clock = int.from_bytes(payload[6:10], "big") + period
            payload, port = payload[:6] + clock.to_bytes(4, "big") + payload[10:], port + 1
        return replace(item, time_ns=item.time_ns + period * 10**9, payload=payload, source=(address, port))

    diagnosis = examine(write(tmp_path / "twice.pcap", [*first, *map(later, first)]), Options())
    told = sorted(found(diagnosis, "cfs_restart"), key=lambda item: item.start_ns)
    assert len(told) == 3  # the two resets, and where the second copy begins
    assert all(item.span[0] < item.span[1] for item in told)
    assert all(one.span[1] <= next_.span[0] for one, next_ in pairwise(told))


def test_a_clock_that_is_set_three_times_leaves_the_counters_as_they_are():
    diagnosis = examined("clock_set")
    assert diagnosis.lost == 54
    steps = [
        item.reason.partition(" was set ")[2].partition(" at ")[0] for item in found(diagnosis, "clock_jump")
    ]
    assert [step.partition(" s ")[0] for step in steps] == [
        "ahead by 998989.5",
        "back by 500.0",
        "ahead by 2.5 s",
    ]


def test_two_commands_for_one_robot_are_each_found_again():
    diagnosis = examined("slow_app")
    came = [chain(diagnosis, msg_id)["application to robot"]["out"] for msg_id in ("0x1827", "0x1828")]
    assert came == [57, 15]  # counted at the robot, by the MsgId in its values


def test_what_ci_read_before_a_command_that_came_out_does_not_wait_in_its_socket():
    assert not any(row.waiting for row in examined("chaos").balance if row.msg_id == 0x1806)
    hops = chain(examined("long_commands"), "0x1829")
    assert [hop["waiting"] for hop in hops.values()] == [0] * len(hops)


def test_a_sender_that_is_named_by_his_processor_too_is_no_other():
    (verdict,) = found(examined("network_bad"), "unknown_peer")
    assert (verdict.lost, verdict.reason[:28]) == (1, "SBN messages of 153:3, which")


def test_a_command_that_leaves_to_the_robot_and_on_sbn_is_not_put_behind_the_robot():
    hops = chain(examined("sbn_peer"), "0x1827")
    assert "application to robot" not in hops
    assert hops["application"]["out"] == 196  # all to the robot, and those on SBN while the peer was there
    pipe = hops["SBN_3_66_Pipe"]
    assert (pipe["in"], pipe["entered"], pipe["elsewhere"]) == (175, 0, 196 - 175)
    (first, *_, last) = chain(examined("processor_reset"), "0x1827")
    assert (first, last) == ("publisher to ground bridge", "application to robot")


def examined_from(name, start_s, end_s):
    """Return what is said of a part of a capture, in seconds from its first datagram."""
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    batches = list(open_file(FOLDER / f"{name}.pcap.zst").batches())
    since = int(batches[0].time_ns[0])
    for batch in batches:
        inside = (batch.time_ns >= since + int(start_s * 1e9)) & (batch.time_ns <= since + int(end_s * 1e9))
        kept = batch.take(np.flatnonzero(inside))
        examination.add(kept, bench.columns.decode(kept))
    return examination.diagnose()


def test_what_the_first_counter_of_a_part_may_have_counted_is_not_lost_behind_telemetry_output():
    """All 50 of 0x827 that the whole lost were over its limit, and all 31 of the part, 3 uncounted."""
    part = examined_from("clock_set", 26.32, 32.57)
    assert not found(part, "lost_after_cfs")
    lost = Counter()
    for item in part.verdicts:
        lost[item.rule] += item.lost or 0
    assert +lost == {"to_message_limit": 26 + 2}
    assert part.uncertain == 3


def test_what_a_peer_that_had_been_given_up_lacks_was_not_lost_on_the_network():
    """The part begins when the peer is silent already, and ends before three of its datagrams are there."""
    part = examined_from("sbn_peer", 6.36, 24.9)
    assert not found(part, "lost_after_cfs")
    # A few runs of missing frames explain all of them.
    assert (part.lost, part.unaccounted, part.uncertain) == (0, 0, 22)


def test_a_peer_whose_first_datagram_of_a_part_is_no_greeting_was_there_before():
    """The bridge of n12 connected at 0.9 s, and has nothing to say for the first four seconds of the part."""
    part = examined_from("../n12_two_hosts_ground", 8.42, 30.12)
    assert part.lost == 0
    assert {item["states"][0]["time_ns"] > part.start_ns for item in part.peers} == {True}


def test_what_became_of_bad_datagrams_is_told_by_events_alone():
    """Here SBN polls and has no receive task; five too short ones came out as the message before them."""
    verdicts = found(examined("network_bad"), "bad_network_message")
    assert not any("receive task" in item.reason for item in verdicts)
    short = [item for item in verdicts if "shorter than" in item.reason]
    assert {item.lost for item in short} == {None}
    assert all("perhaps taken with older bytes" in item.reason for item in short)
    task = examine(ROOT / "tests/captures/f_sbn_disconnect.pcap.zst", Options())
    refused = [item for item in found(task, "bad_network_message") if item.lost]
    assert refused
    assert all("its receive task ended and started anew" in item.reason for item in refused)
    assert all("Creating recv task" in item.evidence[-1] for item in refused)


def test_a_topic_whose_commands_end_at_ci_was_not_overwritten():
    diagnosis = examined("long_commands")
    (silent,) = found(diagnosis, "topic_silent")
    assert silent.msg_id == 0x828
    assert "overran" not in silent.reason


def test_no_more_are_lost_behind_the_last_than_went_in_behind_it():
    diagnosis = examined("two_robots")
    lost = {(line.topic, line.sent): ended(line)["lost"] for line in diagnosis.headlines}
    # One count of 0x1828 may as well be of 0x182a, whose way out lacks as many.
    assert (lost["0x0829", 300], lost["0x1828", 340] + lost["0x182a", 300]) == (115, 95)
    assert lost["0x182a", 300] <= 1
    assert sum(row.unaccounted for row in diagnosis.balance) == 0


def test_what_a_silent_peer_surely_missed_is_not_doubted():
    (verdict,) = found(examined("two_robots"), "sbn_timeout")
    assert verdict.lost == 54  # its next datagram was due before the first of them
    assert not any("heard" in line for line in verdict.evidence)


def test_what_came_over_the_network_while_cfs_was_down_is_lost_there():
    diagnosis = examined("down_with_peer")
    (restart,) = found(diagnosis, "cfs_restart")
    assert restart.lost == 39 + 43
    (row,) = [row for row in diagnosis.balance if row.hop == "SBN socket"]
    assert (row.msg_id, row.came, row.lost) == (0x1829, 250, {"down": 43})
    (crossing,) = found(diagnosis, "crossing_loss")
    assert (crossing.lost, crossing.cause) == (53, "disabled")
    assert crossing.reason.endswith("while Telemetry Output was not enabled")


def test_commands_without_values_are_those_that_the_counter_has():
    diagnosis = examined("no_ops")
    (pipe,) = found(diagnosis, "app_pipe_limit")
    refused = found(diagnosis, "bad_command")
    assert not found(diagnosis, "unattributed_loss")
    assert (pipe.lost, pipe.of, sum(item.lost for item in refused)) == (70, 160, 41)
    (row,) = [row for row in diagnosis.balance if (row.msg_id, row.hop) == (0x1827, "application")]
    assert (row.out, row.not_captured) == (92, 49)
