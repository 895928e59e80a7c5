"""The loop that reads: what it hands on, and what ends it."""

import itertools
import os
import signal

import numpy as np
import pytest
from waiting import until

from edoras_tools.errors import CaptureError, ConfigError, InterruptError
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.pipelines.selection import Period, Selection


def counts(source, bench, *options, **keywords):
    with reading(source, bench, *options, **keywords) as loop:
        return [len(rows) for rows in loop], loop


def test_chosen_rows_of_every_batch_also_of_empty_ones(bench, batches, made_up):
    given = [batches[0], batches[0].take(slice(0, 0)), batches[1]]
    source = made_up(given)
    with reading(source, bench, Selection(msg_ids=(0x1880,))) as loop:
        for batch, rows in zip(given, loop, strict=True):
            own, columns = rows.alone()
            assert rows.batch is batch
            assert len(rows) == len(own) == len(columns) == (rows.columns.msg_id == 0x1880).sum()
            assert rows.begin_ns == int(batches[0].time_ns[0])
    assert source.closed
    assert (loop.failure, loop.interrupted) == (None, False)


@pytest.mark.parametrize(("count", "taken"), [(0, [100, 100]), (1, [1]), (100, [100]), (101, [100, 1])])
def test_count(count, taken, bench, batches, made_up):
    assert counts(made_up(batches[:2]), bench, None, Limits(count))[0] == taken


def test_duration(bench, batches, made_up):
    times = itertools.count()
    limits = Limits(duration_ns=3, clock=lambda: next(times))
    assert counts(made_up(itertools.repeat(batches[0])), bench, None, limits)[0] == [100] * 3


def test_a_duration_of_a_live_source_ends_after_what_has_arrived(bench, batches, made_up):
    """A consumer that is too slow is behind when the time is over: it gets the rest."""

    class Live(made_up):
        live, stops = True, 0

        def stop(self):
            self.stops += 1

        def batches(self):
            yield from batches[:5]
            assert self.stops  # else it would go on without end

    times = itertools.count()
    source = Live([])
    limits = Limits(duration_ns=2, clock=lambda: next(times))
    assert counts(source, bench, None, limits)[0] == [len(item) for item in batches[:5]]
    assert source.closed


def test_what_is_not_read_is_not_decoded_either(bench, batches, made_up):
    times = batches[0].time_ns
    with reading(made_up(batches[:1]), bench, examined=Period(0, int(times[7] - times[0]))) as loop:
        (rows,) = loop
    assert len(rows) == len(rows.batch) == len(rows.columns) == 7
    assert (loop.begin_ns, loop.last_ns, loop.outside) == (times[0], times.max(), 93)


@pytest.mark.parametrize("period", [Period(), Period(20), Period(0, 20), Period(10, 20)])
def test_a_period_holds_one_time_as_it_holds_many(period):
    times = [-5, 0, 9, 10, 19, 20]
    after, before = period.start_ns or -10, period.end_ns or 100
    expected = [after <= time < before for time in times]
    assert period.holds(np.array(times)).tolist() == expected
    assert [period.holds(time) for time in times] == expected


def test_a_failure_comes_after_what_was_read_and_is_raised_or_kept(bench, batches, made_up):
    broken = [batches[0], CaptureError("x.pcap: ends inside record 101")]
    taken, loop = counts(made_up(broken), bench, keeps_failure=True)
    assert taken == [100]
    assert "record 101" in str(loop.failure)
    seen, source = [], made_up(broken)
    with pytest.raises(CaptureError, match="record 101"), reading(source, bench) as loop:
        seen += map(len, loop)
    assert source.closed


def test_a_failure_of_the_work_is_never_kept(bench, batches, made_up):
    source = made_up(batches)
    loop = None

    def work():
        nonlocal loop
        with reading(source, bench, keeps_failure=True) as loop:
            for _ in loop:
                raise CaptureError("disk full")

    with pytest.raises(CaptureError, match="disk full"):
        work()
    assert loop.failure is None
    assert source.closed


def test_a_mistake_in_the_selection_closes_the_source(bench, batches, made_up):
    source = made_up(batches)
    with pytest.raises(ConfigError, match="nothing"), reading(source, bench, Selection(where="nothing == 1")):
        pass
    assert source.closed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_ends_it_after_the_batch_at_hand(number, bench, batches, made_up):
    before, taken = signal.getsignal(number), []
    with reading(made_up(batches), bench, keeps_failure=True) as loop:
        for rows in loop:
            taken.append(len(rows))
            os.kill(os.getpid(), number)
    assert (taken, loop.interrupted) == ([100], True)
    assert isinstance(loop.failure, InterruptError)
    assert str(loop.failure) == "made up: interrupted; everything before was read"
    assert signal.getsignal(number) is before


def test_after_ctrl_c_a_live_list_ends_soon_and_says_what_it_does_not_show(bench, batches, made_up):
    class Live(made_up):
        live = True

        def stop(self):
            pass

        def discard(self):
            return 1000

    now = [0]
    with reading(Live(batches), bench, None, Limits(clock=lambda: now[0])) as loop:
        assert not loop.stops_early(5)
        os.kill(os.getpid(), signal.SIGINT)
        until(lambda: loop.interrupted)
        assert not loop.stops_early(5)
        now[0] += 10**9
        assert loop.stops_early(5)
    assert bench.columns.context.notes == ["not shown: 1,005 packets that had arrived before Ctrl-C"]
