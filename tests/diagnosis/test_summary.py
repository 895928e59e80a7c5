"""The first screen: true to the balance, on one screen for every capture, in plain words."""

import re
from functools import cache

import pytest
from effort import LONG
from places import ROOT
from rich.console import Console
from truth import examined

from edoras_tools.diagnosis.summary import summarize
from edoras_tools.render.doctor import screen

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
    "In the rest: 37 messages were lost: 0x1827 and an unknown MsgId.",
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
        ("no_ops", "and a MsgId and function code that an application has"),
    ],
)
def test_sentences_fit_what_they_tell(name, sentence, diagnosed):
    shown = " ".join(line.strip() for line in lines(diagnosed(name), 120))
    assert sentence in shown


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
