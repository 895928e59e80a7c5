"""Causes that stand in a capture (commands, events, who sent what): each is named, nobody else is blamed."""

from __future__ import annotations

import random
import struct

import pytest
from mutations import changed, frames, is_to, write
from places import ROOT
from truth import FOLDER

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.scheduler import SleepUntil, Work
from edoras_tools.cfs import executive_services
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.model import Endpoint
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, envelope

SEASON = ROOT / "tests/captures/season3"
ES_COMMAND, TO_COMMAND = 0x1806, 0x1880
STATION = Endpoint("127.0.0.1", 40_000)
OTHER = Endpoint("127.0.0.9", 40_000)


def season(lab, name):
    return lab.read(SEASON / f"{name}.pcap.zst")


def told(found, rule):
    return [item for item in found.verdicts if item.rule == rule]


def lost_by(found):
    total = {}
    for row in found.balance:
        for cause, number in row.lost.items():
            total[cause] = total.get(cause, 0) + number
    return total


def test_two_senders_of_one_topic_are_named(lab):
    found = season(lab, "q17_two_bridges_same_topic")
    worst = max(told(found, "app_pipe_limit"), key=lambda item: item.lost)
    assert "2 senders sent it at once (127.0.0.1:1235 at 6.0 Hz, 127.0.0.1:55758 at 6.0 Hz)" in worst.reason
    assert worst.remedy.startswith("send at most 7.9 Hz in all, 3.9 Hz each of 2 senders")


def test_senders_one_after_the_other_are_not_two_at_once(lab):
    sent, _ = lab.simulate("rover", seconds=40, hz=10.0)
    later = lab.start_ns + 20 * SECOND
    moved = [
        item._replace(source=OTHER) if item.destination.port == 1234 and item.time_ns > later else item
        for item in sent
    ]
    found = lab.examine(moved)
    assert told(found, "app_pipe_limit")
    assert not any("senders" in item.reason + item.remedy for item in told(found, "app_pipe_limit"))


def test_a_relay_that_doubles_is_named(lab):
    found = lab.read(ROOT / "tests/captures/season3/q07_uplink_dup_loss_reorder_cfs.pcap.zst")
    (verdict,) = told(found, "app_pipe_limit")
    assert "datagrams are copies that came 21 ms after an equal one, the others at 7.0 Hz" in verdict.reason


@pytest.mark.long("c4*")
@pytest.mark.parametrize("name", ["a_rover", "c4_cmd_rate", "season3/q01_two_causes_one_counter"])
def test_one_sender_that_repeats_itself_is_no_crowd(lab, name):
    found = lab.read(ROOT / f"tests/captures/{name}.pcap.zst")
    assert told(found, "app_pipe_limit")
    assert not any("at once (" in item.reason or "copies" in item.reason for item in found.verdicts)


def test_limits_that_commands_set_are_named_and_nothing_is_missing_between(lab):
    found = season(lab, "q12_to_limits_changed")
    reasons = [item.reason for item in told(found, "to_message_limit")]
    assert any(
        "TO keeps 1 of this MsgId" in line and "(set by a command at 21.0 s)" in line for line in reasons
    )
    assert any(
        "TO keeps 2 of this MsgId" in line and "(set by a command at 51.8 s)" in line for line in reasons
    )
    (problem,) = (item for item in summarize(found).problems if item.lost == 254)
    assert "TO keeps 1 of this MsgId" in problem.text
    assert "(set by a command at 21.0 s); 2 from 51.8 s on: 206 of these" in problem.text
    stops = told(found, "to_stopped")
    assert [item.reason.partition("0x0827 at ")[2] for item in stops] == [
        "19.8 s, and to send it again, at most 1 a round, at 21.0 s",
        "37.2 s, and to send it again, at most 20 a round, at 38.4 s",
        "50.6 s, and to send it again, at most 2 a round, at 51.8 s",
    ]
    assert not any("published meanwhile" in line for item in stops for line in item.evidence)


def test_a_single_message_without_a_subscriber_is_told_as_one(lab):
    found = lab.read(ROOT / "tests/captures/e_ci_errors.pcap.zst")
    several, one = told(found, "no_subscriber")
    assert "1 of these arrived, or had another cause" in several.evidence
    assert one.reason == "1 message on 0x1fff without a subscriber in cFS: dropped by the software bus"


def test_later_fragments_that_a_firewall_dropped(lab):
    found = season(lab, "q08b_later_fragments_dropped")
    assert lost_by(found) == {"fragments": 80}
    (verdict,) = told(found, "lost_after_cfs")
    assert (verdict.lost, verdict.confidence) == (80, "high")
    assert "a firewall or a router drops their later fragments" in verdict.reason


def fragment_of(item):
    """Return the identification of an Ethernet frame's IPv4 packet, and its place: 0 if it is the first."""
    identification, place = struct.unpack_from(">HH", item.data, 18)
    return identification, place & 0x1FFF


@pytest.mark.parametrize(("begin_s", "end_s"), [(0, 35), (25, 60), (25, 35)])
def test_fragments_that_are_dropped_when_the_capture_begins_or_ends(begin_s, end_s, lab, tmp_path):
    """No sequence count has a gap there: the first fragments show what was lost.

    Without any later one, a filter by port may have left them out.
    """
    every = frames(FOLDER / "season3/q08b_later_fragments_dropped.pcap.zst")
    start_ns = every[0].time_ns
    items = [item for item in every if begin_s <= (item.time_ns - start_ns) / SECOND < end_s]
    later = {fragment_of(item)[0] for item in items if fragment_of(item)[1]}
    alone = sum(item.data[20] & 0x20 > 0 and fragment_of(item)[0] not in later for item in items)
    assert alone > 30
    found = lab.read(write(tmp_path / "x.pcap", items))
    assert lost_by(found) == ({"fragments": alone} if later else {})
    assert found.lost + found.uncertain == alone


def test_fragments_of_which_only_the_first_ever_came(lab, tmp_path):
    """No 0x827 is whole: it has no stream, and the commands arrive."""
    every = frames(FOLDER / "season3/q08b_later_fragments_dropped.pcap.zst")
    poses = {fragment_of(item)[0] for item in every if item.data[42:44] == b"\x08\x27"}
    items = [item for item in every if not (fragment_of(item)[1] and fragment_of(item)[0] in poses)]
    found = lab.read(write(tmp_path / "x.pcap", items))
    (row,) = (row for row in found.balance if row.msg_id == 0x827)
    assert (row.lost, row.came) == ({"fragments": len(poses)}, len(poses))


def without_later_fragments(items):
    """Return what a filter by port lets through: later fragments have no port."""
    return [item for item in items if not fragment_of(item)[1]]


@pytest.mark.parametrize(
    ("name", "alone", "lost"),
    [("season3/q08b_later_fragments_dropped", 225, 0), ("flights/losing_network_fragments", 116, 17)],
)
def test_fragments_that_a_filter_by_port_left_out_may_have_come(name, alone, lost, lab, tmp_path):
    items = without_later_fragments(frames(FOLDER / f"{name}.pcap.zst"))
    found = lab.read(write(tmp_path / "x.pcap", items))
    assert (found.lost + found.unaccounted, found.uncertain) == (lost, alone)


def test_gaps_of_messages_that_came_in_part_through_a_filter_by_port_are_no_loss(lab, tmp_path):
    """Every second 0x82d is so long that it comes in fragments."""
    items, number, alone = frames(FOLDER / "flights/losing_network.pcap.zst"), 0, 0
    whole = lab.read(FOLDER / "flights/losing_network.pcap.zst")
    for at, item in enumerate(items):
        if is_to(item.data, 1235) and item.data[42:44] == b"\x08\x2d":
            number += 1
            if number % 2 == 0:
                data, alone = bytearray(item.data[: 34 + (len(item.data) - 34) // 8 * 8]), alone + 1
                data[20] |= 0x20  # more follow
                struct.pack_into(">H", data, 16, len(data) - 14)
                items[at] = item._replace(data=bytes(data), length=len(data))
    found = lab.read(write(tmp_path / "x.pcap", items))
    assert found.lost + found.unaccounted <= whole.lost + whole.unaccounted
    assert found.uncertain == whole.uncertain + alone


@pytest.mark.each(3)
@pytest.mark.parametrize("change", ["1 % removed", "5 % removed", "30 % removed"])
def test_fragments_that_the_capture_missed_here_and_there_were_not_dropped(lab, tmp_path, change):
    items = changed(frames(FOLDER / "season3/q08b_later_fragments_dropped.pcap.zst"), change, 1)
    found = lab.read(write(tmp_path / "x.pcap", items))
    assert found.lost <= 80
    assert found.uncertain > 0


def stalled(scenario, hz, *, seconds=5):
    """Return what an emulated cFS sends whose processors are held from 20 s on, and what is sent to it."""
    profile = SimProfile(work_jitter=0.0)
    start_ns = 1_800_000_000 * SECOND
    simulation = Simulation(profile, scenario, start_ns=start_ns, command_rate_hz=hz)

    def hold():
        yield SleepUntil(start_ns + 20 * SECOND)
        yield Work(seconds * SECOND)

    for _ in range(profile.cores):
        simulation._scheduler.spawn(hold())
    return list(simulation.run(start_ns + 45 * SECOND))


@pytest.mark.quick("rover-7.0")
@pytest.mark.parametrize(("scenario", "hz"), [("rover", 7.0), ("two-rovers", 4.0)])
def test_a_cfs_that_stood_still_is_the_cause_of_what_came_at_once(lab, scenario, hz):
    found = lab.examine(stalled(scenario, hz))
    (verdict,) = told(found, "cfs_stalled")
    zero_ns = found.zero_ns - lab.start_ns
    assert 19 * SECOND < verdict.start_ns - found.zero_ns + zero_ns <= 20 * SECOND
    assert 25 * SECOND <= verdict.end_ns - found.zero_ns + zero_ns < 26 * SECOND
    limits = [item for item in found.verdicts if item.rule in {"app_pipe_limit", "to_message_limit"}]
    assert limits
    assert all("stood still from" in item.reason for item in limits)
    assert told(found, "topic_silent") == []


@pytest.mark.each(3)
@pytest.mark.long("c1*")
@pytest.mark.parametrize("name", ["a_rover", "c1_tlm_rate_limit4", "p4_apps_stopped", "n5_app_restarts"])
def test_a_cfs_of_which_something_comes_did_not_stand_still(lab, name):
    folder = SEASON if name.startswith("p4") else ROOT / "tests/captures"
    assert told(lab.read(folder / f"{name}.pcap.zst"), "cfs_stalled") == []


def stopped_scheduler(lab, scenario):
    name = b"SCH_LAB_APP".ljust(executive_services.APP_NAME_BYTES, b"\0")
    command = cfe.emit_command(ES_COMMAND, executive_services.STOP_APP, name, sequence_flags=0)
    sent, _ = lab.simulate(scenario, seconds=40, hz=2.0, feeds=((15.0, 1234, command),))
    return lab.examine(lab.merged(sent, lab.at(15.0, STATION, lab.ci, command)))


def test_topics_that_a_stopped_scheduler_silenced_are_one_sentence(lab):
    found = stopped_scheduler(lab, "two-rovers")
    (verdict,) = told(found, "topic_silent")
    assert verdict.reason.startswith("9 topics (")
    assert "SCH_LAB_APP was stopped at 14." in verdict.reason


def test_a_stopped_scheduler_takes_no_command_of_a_rover(lab):
    found = stopped_scheduler(lab, "rover")
    assert (found.lost, found.unaccounted, found.uncertain) == (0, 0, 0)
    (verdict,) = told(found, "to_stopped")
    assert verdict.reason.endswith("SCH_LAB_APP, which asks for housekeeping, was stopped at 14.8 s")


@pytest.mark.each(2)
@pytest.mark.parametrize("back", [True, False])
def test_another_station_that_took_the_telemetry_is_named(lab, back):
    """Captured at the first station's host, where the other's command passes and its telemetry does not."""

    def enable(address):
        return cfe.emit_command(TO_COMMAND, 6, address.encode().ljust(16, b"\0"), sequence_flags=0)

    takes, returns = enable(OTHER.address), enable(STATION.address)
    feeds = [(15.0, 1234, takes), *([(30.0, 1234, returns)] if back else [])]
    sent, _ = lab.simulate("rover", seconds=40, hz=2.0, feeds=feeds)
    commands = [
        lab.at(15.0, OTHER, lab.ci, takes),
        *([lab.at(30.0, STATION, lab.ci, returns)] if back else []),
    ]
    here = [item for item in lab.merged(sent, *commands) if item.destination.address != OTHER.address]
    (verdict,) = told(lab.examine(here), "to_stopped")
    verb = "sent" if back else "sends"
    assert f"it {verb} to 127.0.0.9, for which it was enabled at 14.8 s" in verdict.reason


def test_a_network_that_changes_the_order_is_named(lab):
    sent, _ = lab.simulate("rover", seconds=30, state_hz=4.0)
    chance = random.Random(3)
    late = [
        item._replace(time_ns=item.time_ns + 1_200_000_000)
        if item.destination.port == 1235 and chance.random() < 0.05
        else item
        for item in sent
    ]
    found = lab.examine(sorted(late, key=lambda item: item.time_ns))
    (verdict,) = [item for item in told(found, "duplicated") if "behind" in item.reason]
    assert "came late: the network put" in verdict.reason
    assert found.lost == 0


@pytest.mark.long
def test_of_commands_in_pairs_each_first_one_is_superseded_and_nothing_is_wrong(lab):
    body = b"\0\1\0\0" + bytes(40)
    feeds, commands = [], []
    for number in range(60):
        for place in range(2):
            seconds = 3.0 + number + place / 20
            value = body + struct.pack("<d", number + place / 2)
            data = cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(value), sequence_flags=0)
            feeds.append((seconds, 1234, data))
            commands.append(lab.at(seconds, STATION, lab.ci, data))
    sent, _ = lab.simulate("two-rovers", seconds=66, hz=0.0, feeds=feeds)
    found = lab.examine(lab.merged(sent, *commands))
    assert (found.superseded, found.lost, found.unaccounted, found.bad) == (60, 0, 0, False)
    assert found.worst < Severity.WARNING
