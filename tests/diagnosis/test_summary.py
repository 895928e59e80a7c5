"""The first screen: true to the balance, on one screen for every capture, in plain words."""

import re
from functools import cache

import pytest
from effort import LONG
from places import ROOT
from rich.console import Console
from truth import examined

from edoras_tools.diagnosis.summary import summarize
from edoras_tools.render.doctor import diagnosis, screen

FOLDER = ROOT / "tests/captures"
TOGETHER = "diagnoses"
CAPTURES = [path.name.removesuffix(".pcap.zst") for path in sorted(FOLDER.rglob("*.pcap.zst"))]
FIRST = {
    "a_rover": "About 1 in 7 commands never arrived: 92 of 600 0x1827 were lost.",
    "b_arm_single": "No loss found: all 688 messages arrived.",
    "c4_cmd_rate": "Over half of the commands never arrived: 1,793 of 3,080 0x1827 were lost.",
    "e2_ci_nosubs": "32 commands were lost: 22 of 40 0x1827, 10 of 10 0x18ee.",
    "n11_jointstate_sizes": "44 messages were lost: 32 of 76 0x0828, 12 of 12 0x182a.",
    "n8_time_jumps": "No loss found, but 1 warning:",
    "q07_uplink_dup_loss_reorder_ground": "281 datagrams were not examined. "
    "In the rest: 37 messages were lost: "
    "26 of unknown MsgIds, 11 of 0x1827.",
}


@pytest.fixture(scope="module")
def diagnosed():
    """A function: the diagnosis of a capture, made once."""

    @cache
    def diagnosis(name):
        (path,) = FOLDER.rglob(f"{name}.pcap.zst")
        return examined(path)

    return diagnosis


def lines(found, width, words=""):
    console = Console(width=width, color_system=None)
    with console.capture() as shown:
        console.print(screen(found, width, words), soft_wrap=True)
    return shown.get().splitlines()


@pytest.mark.each(5)
@pytest.mark.quick(
    *("[abef]_*", "c3*", "boots", "chaos", "network_bad", "processor_reset", "sbn_peer", "slow_app"),
    *("two_robots", "n[1358]*", "p*", "q[12]*"),
)
@pytest.mark.parametrize("name", CAPTURES)
def test_the_first_screen_is_true_and_fits(name, diagnosed):
    found = diagnosed(name)
    summary = summarize(found)
    assert sum(item.lost or 0 for item in summary.problems) == found.lost + found.unaccounted
    proven = f"{found.lost + found.unaccounted:,}"
    figures = re.findall(r"[\d,]*\d", summary.headline)
    assert (proven in figures or proven == "1") == bool(found.lost + found.unaccounted)
    assert ("No loss found" in summary.headline.replace("no loss", "No loss")) != bool(
        found.lost + found.unaccounted
    ) or not found.datagrams
    counts = [item.lost for item in summary.problems if item.lost]
    assert counts == sorted(counts, reverse=True)
    for width in (80, 120):
        shown = lines(found, width, f"{name}.pcap")
        assert sum(max(1, -(-len(line) // width)) for line in shown) <= 23  # the prompt is the 24th
        assert shown[-1].startswith(f"More: edoras doctor -v {name}.pcap")
        assert max(len(line) for line in shown if "edoras" not in line) <= width
        # What can be pasted stands on a line of its own, and whole.
        assert [
            line for line in shown[:-1] if "edoras " in line and not line.strip().startswith("edoras ")
        ] == []


@pytest.mark.each(3)
@pytest.mark.parametrize("name", FIRST)
def test_line_1_says_the_total(name, diagnosed):
    assert summarize(diagnosed(name)).headline == FIRST[name]


def test_the_figures_of_line_1_add_up_with_names_of_a_mission():
    """One MsgId may have a topic on one link alone."""
    missions = tuple(sorted((ROOT / "samples/missions").glob("two_rovers_*.yaml")))
    headline = summarize(examined(ROOT / "samples/captures/d3_cpu1_cpu2.pcap.gz", (), missions)).headline
    assert "6,599 messages were lost: 3,641 of 4,239 /robot_1/ground/pose, 2,214 of 3,719 0x0828" in headline
    assert "744 with 18 other MsgIds." in headline


def test_all_that_is_told_of_a_loss_is_told_once(diagnosed):
    for name in CAPTURES if LONG else FIRST:
        summary = summarize(diagnosed(name))
        told = [id(verdict) for item in summary.problems if not item.lost for verdict in item.verdicts]
        assert len(told) == len(set(told))
        explained = {id(verdict) for item in summary.problems if item.lost for verdict in item.verdicts}
        assert explained.isdisjoint(told)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("e_ci_errors", "1 of 17 commands on 0x1827 is longer than CI's 768 bytes"),
        (
            "scheduler_stopped",
            "9 topics (0x0805 (TIME_HK), 0x0884 (CI_HK), 0x0801 (EVS_HK), 0x0803 (SB_HK), ...)",
        ),
        ("no_ops", "send whole commands of up to 768 bytes, with a MsgId and function code in use"),
        ("refused_and_over_limits", "200 of 481 TO_CMD: unknown function code; it is refused"),
        ("refused_by_length", "3 faults; the first, 0x1827, packet 186: unknown function code"),
        ("damaged_commands", "send CDR of the configured type, and its length in buffer_length"),
        (
            "both_bridges_off",
            "38 of 782 messages of 9 MsgIds to port 127.0.0.1:1235, where nobody listened, 17",
        ),
        ("doubled_uplink", "Some may be copies: 0 to 11 of their messages never arrived."),
        ("burst_at_the_end", "11 of 0x082d, 0x1827 or 0x1828 on the software bus"),
        ("burst_at_the_end", "5 of 220 0x1827, 11 of 0x082d, 0x1827 or 0x1828. Up to 2 more may be lost."),
        ("added_too_short", "135 messages were lost: 133 of 0x082e, 2 of TO_CMD."),
        ("two_tcp", "1,088 of 1,350 0x0829 (SBN, cFS 66:1), 1,053 with 2 other MsgIds."),
        ("ci_stopped_for_good", "68 messages were lost: 66 of 132 0x1827, 2 of CI_SEND_HK."),
        ("flood_of_a_stranger", "spread all that is sent to CI, most of it by 127.0.0.1:42694: it reads 11"),
        ("flood_of_four_kinds", "send CI at most 21.7 Hz in all, 7.9 Hz of each MsgId (up to 79 a second"),
        (
            "flood_of_four_kinds",
            "108 of 200 0x18ee without a subscriber in cFS, or what an application sends on",
        ),
        ("captured_amid_a_flood", "do send at most 7.9 Hz (up to 50 a second were sent) left 0 of 290"),
        ("limits_one_three_seven", "(set by a command at 8.0 s); 3 from 15.0 s on, 7 from 22.0 s on"),
        ("processor_restarted", "56 while cFS was down, 12.2 to 18.3 s, after ES RESTART (packet 297)"),
        ("stop_without_events", "146 while EDORAS_APP did not run, after STOP_APP EDORAS_APP"),
        (
            "n5_app_restarts",
            "28 of 310 0x1827 while CI was restarted, 15.4 to 20.8 s, after RESTART_APP CI_LAB_APP",
        ),
        ("all_restarted", "20.3 to 32.7 s, after RESTART_APP EDORAS_APP and RESTART_APP SBN"),
        ("peers_flood_each_other", "957 of 1,025 0x0828 at TO_LAB_TLM_PIPE of cFS 66:2, 12.4 to 20.9 s: TO"),
        ("processor_of_peers_restarted", "28 of 444 0x1827 and 0x1828 while cFS 66:1 was down"),
        ("peer_killed_and_stopped", "371 of 1,968 messages of 22 MsgIds sent to SBN peer 66:2 while it was"),
        ("frames_in_bursts", "No loss found. Up to 17 messages may be lost. 2 warnings:"),
        ("bursts_at_a_pipe_of_four", "89 of 799 messages of 3 MsgIds at EDORAS_APP_PIPE: the pipe was full"),
        ("robot_ends_after_its_commands", "see whether the robot, or its simulator, runs"),
        ("few_errors_come_back", "All but these arrived, as far as this capture shows."),
        (
            "stopped_out_of_sight",
            "may be lost: nothing here shows whether an application took them (STOP_APP",
        ),
    ],
)
def test_sentences_fit_what_they_tell(name, sentence, diagnosed):
    shown = " ".join(" ".join(lines(diagnosed(name), 120)).split())
    assert sentence in shown


def test_of_what_is_lost_long_after_it_was_sent_no_share_is_shown(diagnosed):
    """A span of losses has fewer messages that were sent in it than were lost, if these waited before."""
    console = Console(width=80, color_system=None)
    with console.capture() as shown:
        console.print(diagnosis(diagnosed("three_losses_flight"), "flight", 80))
    (line,) = (line for line in shown.get().splitlines() if line.strip().startswith("35.0 to 40.8 s"))
    assert line.split()[4:6] == ["52", "24"]
    assert "%" not in line


def test_a_clean_rate_is_known_as_in_the_advice(diagnosed):
    """What the screen calls measured is so in tables and charts."""
    found = diagnosed("q27_three_hops_one_counter")
    rows = {row["msg_id"]: (row["limit_hz"], row["limit_from"]) for row in found.routes}
    assert (rows["0x0829"], rows["0x082b"]) == ((8.0, "measured"), (40.0, "measured"))
    assert "40 a second get through (measured)" in " ".join(lines(found, 120))


def test_a_remedy_of_several_problems_is_said_once(diagnosed):
    shown = "\n".join(lines(diagnosed("n5_app_restarts"), 80))
    assert shown.count("send nothing while an application does not run") == 1


def test_a_small_screen_has_the_worst_problem_and_counts_the_others(diagnosed):
    found = diagnosed("d3_cpu1_cpu2")
    console = Console(width=80, color_system=None)
    with console.capture() as shown:
        console.print(screen(found, 80, lines=11))
    text = shown.get()
    assert len(text.splitlines()) <= 11
    assert "  3,641  of 4,239 0x0828 at TO_LAB_TLM_PIPE" in text
    rest = found.lost - 3641
    assert f"Also {rest:,} lost in " in text


def test_frames_that_the_capture_lost_are_no_messages(lab):
    found = lab.examine(lab.simulate()[0], drops=500)
    numbers = [int(word) for word in summarize(found).fine.replace(",", "").split() if word.isdigit()]
    assert max(numbers) < 500 == sum(row.not_captured for row in found.balance if row.hop == "capture")
