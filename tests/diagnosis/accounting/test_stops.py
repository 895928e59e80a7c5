"""Applications that stop, and nothing shows what comes out: said as unaccounted, never as arrived."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from scenarios import START_NS, Flight, application, examined, fly, truth

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.cfs import executive_services as es
from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.accounting.closed import outages
from edoras_tools.diagnosis.accounting.losses import Outage
from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE
from edoras_tools.diagnosis.evidence.timeline.table import Change, StateOwner, Timeline
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import ROBOT_PORT
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from tests.support.balance import arrived, ended, wrong_rows

SENT, REACHED_THE_ROBOT = 310, 174
TWIST, OTHER = 0x1827, 0x1828


def without_the_robot(*, other=False):
    """Return what is said of n5 without the robot link; every other command on a second MsgId if asked."""
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    at = 0
    for batch in open_file(ROOT / "tests/captures/n5_app_restarts.pcap.zst").batches():
        kept = batch.take(np.flatnonzero(batch.destination_port != ROBOT_PORT))
        for row in range(len(kept)):
            start = int(kept.offset[row])
            if kept.data[start : start + 2].tobytes() == TWIST.to_bytes(2, "big"):
                at += 1
                if other and at % 2:
                    kept.data[start + 1] = OTHER & 0xFF
        examination.add(kept, bench.columns.decode(kept))
    return examination.diagnose()


def test_what_is_sent_around_a_start_is_uncertain():
    found = without_the_robot()
    (line,) = [item for item in found.headlines if item.topic == "0x1827"]
    assert (line.sent, arrived(line)) == (SENT, None)
    # Two may have been on their way when the capture ended, and CI may have ended as soon as it was told to.
    ends = ended(line)
    assert SENT - REACHED_THE_ROBOT <= ends["lost"] + ends["uncertain"] <= SENT - REACHED_THE_ROBOT + 6
    assert (ends["unaccounted"], ends["uncertain"]) == (0, found.uncertain)
    assert found.uncertain > 0
    assert wrong_rows(found.balance) == []
    (verdict,) = [item for item in found.verdicts if item.rule == "crossing_loss"]
    assert "Stop Application EDORAS_APP" in verdict.reason


def test_where_the_application_may_take_either_of_two_none_is_said_to_be_lost_by_its_stop():
    whole, found = without_the_robot(), without_the_robot(other=True)
    stopped, none = (
        sum(row.lost.get(cause, 0) for row in case.balance for cause in ("stopped", "restart_failed"))
        for case in (whole, found)
    )
    assert stopped > none == 0
    assert found.uncertain == whole.uncertain + stopped
    assert wrong_rows(found.balance) == []


@pytest.mark.parametrize("rule", ["app_outage", "crossing_loss"])
def test_both_are_told(rule):
    assert rule in {item.rule for item in without_the_robot().verdicts}


def two_arms_without(app):
    """Return the rows of a diagnosis in which an application is stopped for 9 s, and all that was lost."""
    ends = application(10.0, es.STOP_APP, app), application(19.0, es.START_APP, app)
    simulation, sent = fly(Flight("two-arms", SimProfile(), 5.0, 1.0, 30, 5, ends))
    result = examined(sent)
    rows = {row["msg_id"]: row for row in result["balance"] if row["hop"] == "application"}
    return rows, result, truth(simulation, sent).most


def test_of_what_was_to_leave_over_a_stopped_sbn_one_message_a_round_is_lost():
    rows, result, most = two_arms_without("SBN")
    for msg_id in ("0x1827", "0x1828"):
        lost = rows[msg_id]["lost"]
        assert 17 <= lost <= 19, "the application sends twice a second"
        assert rows[msg_id]["superseded"] == rows[msg_id]["in"] - rows[msg_id]["out"] - lost
    assert result["unaccounted"] == 0
    # Counted by the emulator too, but for what came over SBN to a socket that was closed.
    assert result["lost"] <= most + 2 * 9


def test_what_an_application_keeps_while_nobody_wakes_it_gives_way_to_the_newest():
    rows, result, most = two_arms_without("SCH_LAB_APP")
    assert result["lost"] <= most
    assert result["unaccounted"] == 0
    assert [row["lost"] for row in rows.values()] == [0, 0, 0, 0]


def lost_of(result, msg_id):
    return sum((Counter(row["lost_by"]) for row in result["balance"] if row["msg_id"] == msg_id), Counter())


def test_a_full_pipe_of_a_restarted_application_loses_by_its_restart_and_wake_ups_are_their_own():
    ends = (application(12.0, es.RESTART_APP, "EDORAS_APP"),)
    simulation, sent = fly(Flight("two-rovers", SimProfile(), 6.0, 3.0, 30, 8, ends))
    result, lost = examined(sent), Counter()
    for item in simulation.cfs.account.arrivals:
        lost[item.msg_id] += item.end in LOST
    for msg_id in (0x1827, 0x1828):  # what it held when it was told to end is no proven loss
        told, rows = lost_of(result, f"0x{msg_id:04x}"), result["balance"]
        perhaps = sum(row["uncertain"] for row in rows if row["msg_id"] == f"0x{msg_id:04x}")
        assert set(told) == {"stopped"}
        assert told.total() <= lost[msg_id] <= told.total() + perhaps <= 1.2 * lost[msg_id]
    # Wake-ups are not in the capture: some of them no event names.
    assert 0 < lost_of(result, "0x182b")["limit"] <= lost[0x182B]
    assert result["lost"] <= lost.total()
    assert result["unaccounted"] == 0


@pytest.mark.quick("10*")
@pytest.mark.parametrize("hertz", [6.0, 10.0])
def test_what_a_cfs_may_have_read_just_before_it_was_killed_is_not_said_to_be_lost(hertz):
    simulation = Simulation(SimProfile(), start_ns=START_NS, command_rate_hz=hertz, with_account=True)
    cfs = simulation.cfs
    sent = list(simulation.run(START_NS + 13 * SECOND))
    cfs.halt()
    sent += simulation.run(START_NS + 18 * SECOND)
    cfs.boot()
    enable = cfe.emit_command(
        telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, b"127.0.0.1".ljust(16, b"\0")
    )
    simulation.feed(START_NS + 20 * SECOND, cfs.ci_endpoint, enable)
    sent += simulation.run(START_NS + 34 * SECOND)
    told = lost_of(examined(sent), "0x1827")["down"]
    truth = sum(item.hop == socket(cfs.profile.ci_port) and item.end in LOST for item in cfs.account.arrivals)
    assert truth - hertz <= told <= truth


@pytest.mark.parametrize(
    ("pipe", "is_its_own"),
    [("EDORAS_APP_PIPE", True), ("EDORAS_APP2_PIPE", False)],
)
def test_a_pipe_is_of_the_application_whose_whole_name_it_begins_with(pipe, is_its_own):
    assert Outage("EDORAS_APP", 0, None, 0, 0, "", 0).reads(pipe) == is_its_own


def test_what_was_lost_before_ci_is_not_lost_again_behind_cfs():
    """Telemetry Output sends copies of the commands, and CI's socket is full of them."""
    entry = (TWIST).to_bytes(4, "little") + bytes([0, 0, 20, 0])
    add = 1.0, telemetry_output.COMMAND_MSG_ID, telemetry_output.ADD_PACKET, entry
    profile = SimProfile(app_msg_limit=20, socket_queue=40, seed=7)
    simulation, sent = fly(Flight("two-rovers", profile, 20.0, 1.0, 30, 12, (add,)))
    result = examined(sent)
    assert 0 < result["lost"] + result["unaccounted"] <= truth(simulation, sent).most


def test_what_a_cfs_counts_since_its_boot_shows_how_fast_ci_reads():
    """The first count comes when all is over; at the usual rate CI would have read a third by then."""
    profile = SimProfile(ci_wake_ns=100_000_000, app_msg_limit=20)
    _, sent = fly(Flight("two-rovers", profile, 45.0, 1.0, 17, 16, ()))
    over_ns = START_NS + 16 * SECOND
    late = [item for item in sent if item.payload[:2] != b"\x08\x84" or item.time_ns > over_ns]
    commands = [item for item in late if item.payload[:2] == b"\x18\x27"][::20]
    lost = [item._replace(time_ns=item.time_ns + 1_000_000) for item in commands]  # on the network before CI
    result = examined(sorted([*late, *lost], key=lambda item: item.time_ns))
    assert sum(lost_of(result, msg_id)["network"] for msg_id in ("0x1827", "0x1828")) == len(lost) == 30


def test_an_output_that_was_sent_back_here_before_excuses_no_silence():
    """It was sent elsewhere for 50 ms; a second later the network loses all telemetry for 6 s."""
    enable = telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE
    commands = (9.0, *enable, b"10.9.9.9".ljust(16, b"\0")), (9.05, *enable, b"127.0.0.1".ljust(16, b"\0"))
    profile = SimProfile(app_msg_limit=20, seed=3)
    simulation, sent = fly(Flight("two-rovers", profile, 2.0, 4.0, 30, 8, commands))
    begin_ns, end_ns = START_NS + 10 * SECOND, START_NS + 16 * SECOND
    kept = [
        item
        for item in sent
        if item.destination != simulation.ground.endpoint or not begin_ns < item.time_ns < end_ns
    ]
    assert examined(kept)["lost"] == len(sent) - len(kept) > 100


@pytest.mark.parametrize(("left_s", "is_sure"), [(None, False), (26, True), (31, False)])
def test_a_command_alone_stops_no_sbn_that_stays_with_its_peers(left_s, is_sure):
    """CI's full socket may have dropped it; SBN that ends tells its peers so."""
    command = Change(0, StateOwner("app", "SBN"), "stopped", 25 * SECOND, 30 * SECOND, "STOP_APP", sure=False)
    changes = [command]
    if left_s is not None:
        times = left_s * SECOND, (left_s + 1) * SECOND
        changes.append(Change(0, StateOwner("peer", "66:3"), "disconnected", *times, SAID_GOODBYE))
    found = outages(SimpleNamespace(timeline=Timeline(changes), start_ns=0))
    assert [item.app for item in found] == ["SBN"] * is_sure
