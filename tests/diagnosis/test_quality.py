"""What bounds the losses of a capture: exact binomial bounds, and captures with frames removed at random."""

import random
from fractions import Fraction
from math import comb
from types import SimpleNamespace

import mutations
import numpy as np
import pytest
import truth
from hypothesis import given
from hypothesis import strategies as st
from places import CAPTURES

from edoras_tools.diagnosis.accounting.commands import _missed
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.quality import (
    Evidence,
    Quality,
    _between,
    _rests,
    binomial_tail,
    fewest_runs,
    largest_number,
    largest_share,
    least_runs,
)
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND, SECOND


def exact_tail(missing, checked, share):
    share = Fraction(share)
    return sum(comb(checked, n) * share**n * (1 - share) ** (checked - n) for n in range(missing + 1))


@given(st.integers(1, 60), st.data())
def test_the_tail_is_that_of_exact_fractions(checked, data):
    missing = data.draw(st.integers(0, checked))
    share = data.draw(st.floats(0.0, 1.0))
    expected = float(exact_tail(missing, checked, share))
    assert binomial_tail(missing, checked, share) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("missing", "checked", "confidence", "share"),
    [
        # Clopper and Pearson's 95 % intervals from two sides have these upper ends.
        (5, 100, 0.975, 0.11283),
        (10, 50, 0.975, 0.33718),
        (0, 10, 0.975, 0.30850),
        (1, 20, 0.975, 0.24873),
        (0, 1000, 0.95, 0.0029912),
        (0, 1000, 0.999, 0.0068840),
        (7, 7, 0.999, 1.0),
        (0, 0, 0.999, 1.0),
    ],
)
def test_the_largest_share_is_that_of_tables(missing, checked, confidence, share):
    assert largest_share(checked, missing, confidence) == pytest.approx(share, rel=1e-4)


def test_bounds_of_many_are_bounds_of_few_made_narrower():
    shares = [largest_share(10**power, 10**power // 20) for power in range(2, 8)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] == pytest.approx(0.05, abs=0.0003)


def exact_share(most, checked, others, drawn):
    """Of all ways to miss so many: the share of those with at most so many among the checked."""
    ways = sum(comb(checked, n) * comb(others, drawn - n) for n in range(min(most, drawn) + 1))
    return Fraction(ways, comb(checked + others, drawn))


@given(st.integers(0, 60), st.integers(0, 60), st.data())
def test_the_largest_number_is_that_of_fishers_test(count, checked, data):
    missing = data.draw(st.integers(0, checked))
    number = largest_number(count, checked, missing)
    likely = [float(exact_share(missing, checked, count, missing + n)) for n in range(count + 1)]
    assert likely == sorted(likely, reverse=True)
    assert likely[number] >= 0.001 - 1e-9
    assert number == count or likely[number + 1] <= 0.001 + 1e-9


def test_what_lacks_none_excludes_the_share_that_the_issue_names():
    quality = Quality((Evidence("inputs", 0, 100, 0),))
    assert 0.93**100 < 0.001 < 0.94**100
    assert quality.excludes(0.07)
    assert not quality.excludes(0.06)
    assert not quality.known_zero
    assert 0 < quality.may_have_missed(100) < 25


def test_one_that_lacks_excludes_nothing():
    assert not Quality((Evidence("inputs", 0, 1000, 1),)).excludes(1.0)
    assert not Quality((Evidence("inputs", 0, 1000, 0), Evidence("ci_counts", 0, 200, 3))).excludes(1.0)


def runs_of(captured_s, *streams):
    """Return the least number of runs for streams, each of times and the missing messages behind each."""
    times = np.array(captured_s) * SECOND
    case = SimpleNamespace(
        rows=SimpleNamespace(time_ns=times),
        profile=SimpleNamespace(to_wake_ns=SECOND // 2),
        all_holes=[],
    )
    gappy = [Gappy(missing, np.array(own) * SECOND) for own, missing in streams]
    return least_runs(case, {item: int(item.missing.sum()) for item in gappy})


def test_gaps_of_several_streams_at_one_time_are_one_run():
    streams = ([0, 40], [3, 0]), ([1, 41], [4, 0]), ([2, 42], [2, 0])
    assert runs_of([0, 1, 2, 40, 41, 42], *streams) == 1
    assert runs_of([0, 1, 2, 20, 40, 41, 42], *streams) == 2  # one was captured in between
    assert runs_of([0, 4, 10, 14], ([0, 4, 10, 14], [1, 0, 1, 0])) == 2
    assert runs_of([0, 4], ([0, 4], [0, 0])) == runs_of([0, 4]) == 0


def test_while_others_are_captured_an_outage_is_many_runs():
    assert runs_of(range(31), ([0, 30], [300, 0])) > 10
    assert runs_of([0, 30], ([0, 30], [300, 0])) == 1
    every = list(range(101))
    assert runs_of(every, (every, [1] * 100 + [0])) == 100


def test_a_number_of_messages_is_taken_by_the_runs_that_take_most():
    low, high = np.array([0, 0, 0, 5, 5, 9]), np.array([2, 2, 2, 8, 8, 10])
    assert [fewest_runs(low, high, number) for number in (0, 1, 3, 4, 5, 6, 7)] == [0, 1, 1, 2, 2, 3, 3]
    beside = np.array([0, 1, 2])
    assert fewest_runs(beside, beside + 1, 3) == 3  # frames were captured in between


class Gappy:
    """A stream with gaps, and a message each second if no times are named."""

    counted, link = True, SimpleNamespace(only_to_cfs=False)

    def __init__(self, missing, time_ns=None):
        self.missing = np.array(missing)
        self.time_ns = np.arange(len(missing)) * SECOND if time_ns is None else time_ns

    def __len__(self):
        return len(self.missing)


def test_a_stream_with_more_gaps_of_other_causes_does_not_show_the_runs():
    once, often = Gappy([0] * 50 + [9] + [0] * 49), Gappy([1] * 99 + [0])
    case = SimpleNamespace(streams=[once, often], confidence=0.999, frames=lambda _: 1, all_holes=[])
    case.rows, case.profile = SimpleNamespace(time_ns=once.time_ns), SimpleNamespace(to_wake_ns=SECOND // 2)
    case.quality = Quality((Evidence("periods", 0, 3000, 0),))
    assert dict(_missed(case, {once: [9], often: [1]})) == {once: [9], often: [1]}
    assert dict(_missed(case, {often: [1]})) == {}


def test_a_hole_is_none_of_the_runs_and_hides_none():
    stream = Gappy([0] * 5 + [9] + [0] * 9 + [1] + [0] * 9 + [1] + [0] * 4)
    case = SimpleNamespace(rows=SimpleNamespace(time_ns=stream.time_ns), all_holes=[])
    case.profile = SimpleNamespace(to_wake_ns=SECOND // 2)
    assert least_runs(case, {stream: 2}) == 0  # 9 of 11 have another cause
    case.all_holes = [(5 * SECOND, 6 * SECOND)]
    assert least_runs(case, {stream: 2}) == 2


def test_what_is_missing_in_runs_is_not_bounded_by_its_neighbours():
    alone = Quality((Evidence("identifications", 0, 400, 0),))
    assert alone.excludes(0.1)
    assert not alone.of_runs(1).excludes(0.1)
    both = Quality((*alone.evidence, Evidence("periods", 0, 100, 0)))
    assert both.of_runs(5).excludes(0.1)


def test_a_run_may_take_inputs_with_what_was_made_of_them():
    inputs = Quality((Evidence("inputs", 0, 400, 0),))
    assert inputs.excludes(0.1)
    assert not inputs.of_runs(5).excludes(0.1)
    assert Quality((Evidence("inputs", 0, 400, 3),)).of_runs(5).lacks_answered


def test_a_run_takes_as_many_of_the_datagrams_that_sequence_counts_check():
    """Telemetry Output sends them behind each other, as those of the run: 100 of them are 10 trials."""
    counted = Quality((Evidence("sequence_counts", 0, 100, 0),))
    assert counted.of_runs(1).excludes(0.1)
    assert not counted.of_runs(10).excludes(0.1)
    assert counted.of_runs(10).may_have_missed(100) > 3 * counted.may_have_missed(100)
    commands = Quality((Evidence("ci_counts", 0, 100, 0),))  # these come one by one
    assert commands.of_runs(10).excludes(0.1)


def test_datagrams_that_the_capture_missed_stay_missed_where_they_are_fewer_than_a_run():
    quality = Quality((Evidence("sequence_counts", 0, 4000, 3),))
    assert not quality.excludes(0.1)
    assert not quality.of_runs(4).excludes(0.1)


@pytest.mark.parametrize(("name", "lost"), [("refused_and_over_limits", 499), ("thousand_a_second", 8766)])
def test_runs_of_telemetry_that_the_capture_missed_are_no_loss(tmp_path, name, lost):
    """Of what counters check, less than a run is missing: some, not none. And nothing is checked in holes."""
    chance = random.Random(f"{name}t6x15c3")
    items = mutations.frames(truth.FOLDER / f"flights/{name}.pcap.zst")
    output = [at for at, item in enumerate(items) if mutations.is_to(item.data, 1235)]
    gone = set(chance.sample([at for at, item in enumerate(items) if mutations.is_to(item.data, 1234)], 3))
    for _ in range(6):
        start = chance.randrange(len(output) - 15)
        gone |= {*output[start : start + 15]}
    items = [item for at, item in enumerate(items) if at not in gone]
    found = truth.examined(mutations.write(tmp_path / "x.pcap", items))
    assert found.lost + found.unaccounted <= lost


@pytest.mark.parametrize(("number", "seed"), [(5, 19), (12, 14), (12, 26)])
def test_runs_that_the_capture_missed_are_no_loss_behind_an_overloaded_pipe(tmp_path, number, seed):
    """What the pipe lost hides the runs in one stream, and the counters check a part of the time only."""
    chance = random.Random(seed)
    items = mutations.frames(truth.FOLDER / "season3/q12_to_limits_changed.pcap.zst")
    starts = [chance.randrange(len(items) - 12) for _ in range(number)]
    gone = {at for start in starts for at in range(start, start + 12)}
    items = [item for at, item in enumerate(items) if at not in gone]
    found = truth.examined(mutations.write(tmp_path / "x.pcap", items))
    assert found.lost + found.unaccounted <= 254


@pytest.mark.parametrize(("number", "size", "seed"), [(12, 12, 1), (12, 12, 5), (12, 12, 9), (12, 4, 5)])
def test_commands_that_came_out_in_runs_that_the_capture_missed_are_no_loss(tmp_path, number, size, seed):
    chance = random.Random(seed)
    items = mutations.frames(truth.FOLDER / "flights/each_sent_twice.pcap.zst")
    starts = [chance.randrange(len(items) - size) for _ in range(number)]
    gone = {at for start in starts for at in range(start, start + size)}
    items = [item for at, item in enumerate(items) if at not in gone]
    found = truth.examined(mutations.write(tmp_path / "x.pcap", items))
    assert found.lost + found.unaccounted <= 18 <= found.lost + found.unaccounted + found.uncertain


def test_nothing_checked_may_have_missed_all():
    quality = Quality()
    assert (quality.best[0], quality.upper_share(), quality.may_have_missed(7)) == (0, 1.0, 7)
    assert not quality.excludes(0.99)


def test_counted_drops_of_zero_exclude_unless_all_evidence_lacks_some():
    assert Quality(drops=0).excludes(0.0001)
    assert Quality(drops=0).may_have_missed(10_000) == 0
    assert not Quality(drops=3).excludes(0.9)
    contradicted = Quality((Evidence("inputs", 0, 100, 5),), drops=0)
    assert contradicted.upper_share() > 0.05
    lost_before_the_tap = Quality((Evidence("sequence_counts", 0, 100, 5),), drops=0)
    assert lost_before_the_tap.known_zero


def test_no_more_may_be_missed_than_were_counted_unless_more_are():
    assert Quality((Evidence("inputs", 0, 100, 5),), drops=7).may_have_missed(1000) == 7
    assert Quality((Evidence("inputs", 0, 100, 5),), drops=4).may_have_missed(1000) > 50


def test_a_network_that_loses_on_one_way_does_not_hide_that_the_capture_is_good():
    quality = Quality((Evidence("sequence_counts", 0, 1000, 90), Evidence("identifications", 1, 400, 0)))
    assert quality.best == (400, 0)
    assert quality.excludes(0.09)


def test_two_kinds_about_one_host_are_not_added_up():
    quality = Quality((Evidence("inputs", 0, 300, 0), Evidence("ci_counts", 0, 400, 0)))
    assert quality.best[0] == 400


def test_the_best_of_two_groups_has_to_be_surer():
    alone = Quality((Evidence("inputs", 0, 500, 0),))
    chosen = Quality((*alone.evidence, Evidence("inputs", 1, 300, 9)))
    assert alone.upper_share() < chosen.upper_share() < 1.1 * alone.upper_share()


def between(*packets):
    time_us, identification = zip(*packets, strict=True)
    return _between(np.array(time_us, np.int64) * 1000, np.array(identification, np.uint16))


def test_a_number_between_two_of_one_tick_is_checked():
    assert between((0, 7), (10, 8), (20, 9)) == (1, 0)
    assert between((0, 7), (20, 9)) == (1, 1)


def test_odd_numbers_are_evidence_and_not_checked():
    assert between((0, 8), (10, 9), (20, 10)) == (0, 0)
    assert between((0, 8), (20, 10)) == (0, 0)


def test_numbers_that_a_clock_tick_may_have_skipped_are_not():
    assert between((0, 7), (1200, 9)) == (0, 0)
    assert between((0, 7), (600, 8), (1200, 9)) == (0, 0)
    assert between((0, 7), (20, 10)) == (0, 0)


def test_numbers_wrap_overtake_and_come_twice():
    assert between((0, 65534), (10, 65535), (20, 0), (30, 1)) == (1, 0)
    assert between((0, 5), (10, 7), (20, 6), (30, 8)) == (1, 0)
    assert between((0, 5), (10, 5), (20, 6), (30, 7)) == (1, 0)
    assert between((0, 5)) == (0, 0)


def rests(sent_s, made_s, total, holes=()):
    sent, made = (np.array(np.array(item) * SECOND, np.int64) for item in (sent_s, made_s))
    return [column.tolist() for column in _rests(sent, made, np.array(total), holes)]


def test_counts_of_ci_are_compared_where_it_rests():
    assert rests([3, 4, 9, 11], [0, 7, 10, 15], [1, 3, 4, 6]) == [[2, 3], [2, 2]]


def test_a_count_of_ci_that_goes_on_with_what_waits_is_not_one_of_rest():
    assert rests([3, 4, 9, 20], [0, 7, 12, 13, 25], [1, 3, 3, 4, 5]) == [[2, 2], [2, 2]]


def test_counts_of_ci_that_fall_or_span_a_hole_are_not():
    assert rests([3, 4, 9], [0, 7, 15], [1, 3, 1]) == [[2], [2]]
    hole = [(8 * SECOND, 8 * SECOND + MILLISECOND)]
    assert rests([3, 4, 9], [0, 7, 15], [1, 3, 4], hole) == [[2], [2]]


class Lossy:
    """A capture, read once, of which frames are removed at random."""

    def __init__(self, path):
        self._batches = list(open_file(path).batches())

    def quality(self, share=0.0, seed=0):
        columns = Settings().workbench().columns
        examination, random = Examination(columns.context), np.random.default_rng(seed)
        for batch in self._batches:
            some = batch.take(np.flatnonzero(random.random(len(batch)) >= share))
            examination.add(some, columns.decode(some))
        return examination.diagnose().case.quality


@pytest.fixture(scope="module", params=["a_rover.pcap", "c1_tlm_rate_limit4.pcap.gz"])
def lossy(request):
    return Lossy(CAPTURES / request.param)


@pytest.mark.each(2)
def test_a_whole_capture_lacks_nothing(lossy):
    quality = lossy.quality()
    assert quality.best[1] == 0
    assert quality.best[0] > 400
    assert quality.excludes(0.02)


@pytest.mark.long
@pytest.mark.parametrize("share", [0.01, 0.05, 0.3])
def test_the_true_share_is_below_the_bound(lossy, share):
    for seed in range(4):
        quality = lossy.quality(share, seed)
        assert sum(item.missing for item in quality.evidence) > 0
        assert share <= quality.upper_share() < 2 * share + 0.05
        assert not quality.excludes(share)
