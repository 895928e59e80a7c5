"""Clocks of cFS that slip, and which instance takes up the counts of another: asked of all before at once."""

from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.diagnosis.evidence.clocks import steady
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.sequence import MODULUS

counts = st.dictionaries(st.tuples(st.integers(0, 5)), st.integers(0, 40), max_size=6)


def goes_on(last: dict[tuple[int, ...], int], begin: dict[tuple[int, ...], int]) -> bool:
    """Ask one pair, as it is defined."""
    steps = {item: (begin[item] - last[item]) % MODULUS for item in begin if item in last}
    taken = [item for item, step in steps.items() if 0 < step <= steady._NEXT]
    few = len(steps) <= 2 and any(begin[item] <= steady._NEXT for item in steps)  # a boot begins as low
    return bool(steps) and not few and len(taken) > steady._MOST_GO_ON * len(steps)


@given(last=st.lists(counts, max_size=8), begin=counts, end=st.integers(0, 8))
def test_counts_are_taken_up_as_of_each_pair(
    last: list[dict[tuple[int, ...], int]], begin: dict[tuple[int, ...], int], end: int
) -> None:
    end = min(end, len(last))
    pairs = [place for place in range(end) if goes_on(last[place], begin)]
    assert steady._taken_up(steady._places(last), begin, end) == pairs


def test_some_are_taken_up() -> None:
    last = [{(stream,): 7 for stream in range(4)}, {(stream,): 9000 for stream in range(4)}]
    assert steady._taken_up(steady._places(last), {(stream,): 8 for stream in range(4)}, 2) == [0]


def test_a_clock_that_slipped_and_an_output_that_woke_at_another_time_are_told_apart() -> None:
    """By the console of n5 its clock fell back by 0.1 s, and Telemetry Output was restarted."""
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    for batch in open_file(ROOT / "tests/captures/n5_app_restarts.pcap.zst").batches():
        examination.add(batch, bench.columns.decode(batch))
    delays = {row["msg_id"]: row["delay"] for row in examination.diagnose().routes if row["delay"]}
    own = delays.pop("0x0880")
    assert 480 < own["p50_ms"] <= own["max_ms"] < 510  # what it makes itself waits for one round
    assert max(delay["max_ms"] for delay in delays.values()) < 500  # and nothing for longer
    assert 290 < delays["0x0800"]["p50_ms"] < 320


def test_the_clock_of_the_capture_set_ahead_is_not_laid_on_cfs() -> None:
    """Nobody sends for 3 s, and mission time does not go on meanwhile: only the capture's clock did."""
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    for batch in open_file(ROOT / "tests/captures/b_arm_single.pcap.zst").batches():
        batch.time_ns[batch.number > 400] += 3 * 10**9
        examination.add(batch, bench.columns.decode(batch))
    found = examination.diagnose()
    (jump,) = (item for item in found.verdicts if item.rule == "clock_jump")
    assert jump.reason.startswith("the capture's own clock was set ahead by 3.0 s at packet")
    assert (found.lost, found.unaccounted, found.uncertain) == (0, 0, 0)
