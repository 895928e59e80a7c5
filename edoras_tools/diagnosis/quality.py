"""How much the capture itself may have missed, where it has holes, and what the host's kernel dropped.

In: rows, streams and hops. Out: ``Quality``, whose questions are ``excludes`` (can it have missed such a
share?) and ``may_have_missed`` (how many of so many?); the spans of holes; and ``HostDrops``.

A capture that drops frames at random also drops some frames that other evidence proves to have been sent. So
this file checks datagrams that must have passed the tap because of something else in the capture:

1. *Identifications*. A Linux host numbers its IPv4 packets to one address in sequence. It skips numbers only
   if a clock tick lies between two packets. If the packets before and after a number were captured within a
   millisecond, the packet with that number passed too. Odd numbers check even ones, so that no packet is both
   evidence and checked.
2. *Inputs*. An application made each of its messages from a command. A value that occurs once identifies it.
3. *Counts of CI*. Between two times at which CI's socket is empty, CI counts exactly the datagrams that the
   tap saw. The same holds from the start if CI's count equals that of the tap.
4. *Sequence counts*. While the bus counts no loss, each message that cFS counted also left it.
5. *Periods*. A sender with an even rate sends in each of its periods, except in a pause. The period of a step
   is the median of the steps around it, so the rate may change. A sender that was late catches up at once.
6. *Copies*. If most datagrams were captured twice, each copy checks the other.

How the check works:

7. Whether a datagram is checked never depends on whether it was captured. So the missing ones are a fair
   sample.
8. Evidence of one kind about datagrams of one host is a group. Groups are never added up, because two kinds
   may check the same datagram.
9. A network that loses datagrams before the tap, or traffic that was left out on purpose, can only make a
   group look worse than the capture is. So each group gives an upper bound, and the lowest bound holds. This
   assumes that a tap drops frames regardless of their sender.
10. If CI counted fewer datagrams than the tap saw, commands were lost behind the tap, and these may hide
    datagrams that the capture missed. Then the counts of that CI check nothing.
11. Times without any capture are excluded: they are no random share. Frames captured twice count once.
12. A run of missing frames is one miss. It also took the neighbours whose identifications would show it.

The capture has a hole if nothing was captured although all senders went on:

13. Nothing was captured for one round of Telemetry Output or longer.
14. cFS went on: most of its streams miss sequence counts there.
15. Other steady senders are missing too: a commander, or a second SBN peer. A failed network between two of
    them does not hide both.
16. If one of these two rules fails, the hole is only possible. Then counts are missing, and either rule 14
    holds, or the pause is longer than Telemetry Output and SBN ever wait.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from functools import cache, cached_property, partial
from math import ceil, exp, inf, lgamma, log, log1p, sqrt
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.model import Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import by_key, by_value, distinct, groups, numbered, places_within

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import Track
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.model import HostCounters
    from edoras_tools.wire.arrays import Integers, Mask, Places


EvidenceKind = Literal["identifications", "inputs", "ci_counts", "sequence_counts", "periods", "copies"]

CONFIDENCE: Final = 0.999
_ANSWERED: Final = frozenset({"inputs", "ci_counts"})
_ALONE: Final = _ANSWERED | {"sequence_counts", "copies"}
"""Kinds that can check a datagram even if its neighbours are missing."""
_HIDING: Final = frozenset({"identifications", "ci_counts"})
"""Kinds that may show too few missing: because of bursts, or of losses behind the tap."""
_CHANCE: Final = 0.01
_TICK_NS: Final = MILLISECOND
"""The shortest clock tick of a Linux kernel."""
_ALIKE: Final = 0.5
_MOSTLY_ONCE: Final = 0.9
_START_NS: Final = 2 * SECOND
_REST_NS: Final = 1500 * MILLISECOND
"""CI reads a datagram within this time, unless its socket is full."""
_LEAST_COUNTED: Final = 20
_EVEN: Final = 0.2
"""A step may differ from the period by this share of it."""
_MOST_PERIODS: Final = 10
"""A sender that is silent for more periods has paused."""
_LATE_NS: Final = 100 * MILLISECOND
_ROUNDS_NS: Final = 2 * SECOND
"""Within this time a message leaves cFS, or is lost on the bus."""
_MOST_MISSING: Final = 64
"""A larger step of a sequence count belongs to another run of the sender."""
FEW_RUNS: Final = 3
"""Any capture may lack so few runs of frames: what was checked between them does not show it."""
_MOST_RUNS: Final = 32
_DEVIATIONS: Final = 12
_BISECTIONS: Final = 60


class Evidence(NamedTuple):
    """Datagrams that must have passed the tap, and how many of them were not captured.

    Attributes:
        kind: kind of evidence, as in the rules above.
        sender: number of the sending host, as in ``Instances.hosts``.
        checked: number of datagrams.
        missing: number of these that were not captured.
    """

    kind: EvidenceKind
    sender: int
    checked: int
    missing: int


class Quality(msgspec.Struct, frozen=True, dict=True):
    """Upper bounds for the datagrams that a capture missed at random.

    Attributes:
        evidence: results of all checks.
        drops: frames that the kernel or the recorder counted as dropped; None without a counter.
    """

    evidence: tuple[Evidence, ...] = ()
    drops: int | None = None

    @property
    def lacks_answered(self) -> bool:
        """Whether a missing datagram surely reached the tap: it was answered, or CI counted it."""
        return any(self._answered)

    @property
    def _answered(self) -> list[int]:
        """The number of missing datagrams in each check by answers."""
        return [item.missing for item in self.evidence if item.kind in _ANSWERED]

    @cached_property
    def sums(self) -> dict[tuple[int, EvidenceKind], tuple[int, int]]:
        """(sender, kind) to the numbers of datagrams checked and missing."""
        parts = by_key(self.evidence, lambda item: (item.sender, item.kind)).items()
        return {key: (sum(one.checked for one in own), sum(one.missing for one in own)) for key, own in parts}

    @cached_property
    def groups(self) -> list[tuple[int, int]]:
        """The numbers of datagrams (checked, missing) of each group that gives a fair bound.

        A burst of drops also takes the neighbours that would check a datagram. So if answers prove that
        datagrams were missed, only kinds that need no neighbours count. Losses behind the tap hide missing
        datagrams from CI's counts. So ``_HIDING`` kinds do not count if the periods of that sender show
        more missing.
        """

        def is_fair(sender: int, kind: str, checked: int, missing: int) -> bool:
            if not checked or (self.lacks_answered and kind not in _ALONE):
                return False
            others, more = self.sums.get((sender, "periods"), (0, 0))
            chance = hypergeometric_tail(missing, checked, others, missing + more)
            return kind not in _HIDING or chance >= _CHANCE

        return sorted({group for key, group in self.sums.items() if is_fair(*key, *group)})

    @cached_property
    def best(self) -> tuple[int, int]:
        """Numbers of datagrams (checked, missing) of the group with the lowest bound; 0 and 0 without any."""
        return min(self.groups, key=lambda group: largest_share(*group), default=(0, 0))

    @property
    def counts(self) -> bool:
        """Whether the count of drops can be trusted: the answers do not all show more datagrams missing.

        Only answered datagrams contradict it: others may be lost before they reach the tap.
        """
        return self.drops is not None and min(self._answered, default=0) <= self.drops

    @property
    def known_zero(self) -> bool:
        """Whether a trusted count of drops is 0."""
        return self.counts and not self.drops

    def upper_share(self) -> float:
        """Return the largest share of frames that the capture can have missed, 0 to 1."""
        return 0.0 if self.known_zero else largest_share(*self.best, self._each(CONFIDENCE))

    def may_have_missed(self, count: int, confidence: float = CONFIDENCE) -> int:
        """Return the largest number of ``count`` datagrams that the capture can have missed."""
        each = self._each(confidence)
        number = min((largest_number(count, *group, each) for group in self.groups), default=count)
        return min(number, self.drops or 0) if self.counts else number

    def perhaps_missed(self, size: int, number: int, runs: int, confidence: float) -> int:
        """Return how many missing messages of a stream the capture itself may have missed, at most.

        Args:
            size: number of messages in the stream.
            number: number of messages that are missing.
            runs: in how many runs of frames it can have missed them.
            confidence: confidence of the bound.
        """
        each = number / runs if 0 < 2 * runs <= number and not self.counts else 1.0
        if each > 1 and runs <= FEW_RUNS:
            return number
        bounds = self.of_runs(each) if each > 1 else self
        if bounds.excludes(number / size):
            return 0
        return min(number, ceil(bounds.may_have_missed(ceil(size / each), confidence) * each))

    def of_runs(self, size: float) -> Quality:
        """Return the bounds for runs of missing datagrams: a run has no neighbours whose numbers show it.

        Telemetry comes in rounds: a run takes as many of what sequence counts check as it takes others.
        Inputs show only missing ones: a run may take what was made of them too.

        Args:
            size: number of datagrams of each run.
        """
        sizes = {"identifications": inf, "sequence_counts": size}
        each = ((kind, who, sizes.get(kind, 1), *both) for (who, kind), both in self.sums.items())
        parts = (Evidence(kind, who, ceil(k / of), ceil(m / of)) for kind, who, of, k, m in each)
        return Quality(tuple(item for item in parts if item.missing or item.kind != "inputs"))

    @property
    def longest_run(self) -> int:
        """The longest run of datagrams that it can have missed at random; 0 if no miss is sure."""
        share = self.upper_share() if self.lacks_answered else 0.0
        return ceil(log(1 - CONFIDENCE) / log(min(share, _MOSTLY_ONCE))) if share else 0

    def excludes(self, share: float) -> bool:
        """Return whether the capture cannot have missed this share: one of the checked would be missing.

        If the capture surely missed datagrams, no share is excluded: any missing datagram may be one of them.
        """
        each, groups = self._each(CONFIDENCE), () if self.lacks_answered else self.groups
        return self.known_zero or any(
            share > largest_share(checked, missing, each) for checked, missing in groups if not missing
        )

    def _each(self, confidence: float) -> float:
        """Return the confidence for each group, because the best of several groups is chosen (Bonferroni)."""
        return 1 - (1 - confidence) / max(len(self.groups), 1)


def assess_quality(case: Case) -> Quality:
    """Return the bounds for the datagrams that a capture missed."""
    rows, checks = case.rows, (_identifications, _inputs, _ci_counts, _sequence_counts, _periods)
    evidence = [item for check in checks for item in check(case) if item.checked]
    # Cut frames cannot be matched with their answers, but CI's surplus over the capture still counts.
    if rows.has(Finding.CAPTURE_CUT).any() and not Quality(tuple(evidence)).lacks_answered:
        counts = (
            (item.endpoint, item.read_count + item.not_captured, item.not_captured) for item in case.ingests
        )
        evidence += [Evidence("ci_counts", *item) for item in counts if item[2]]
    once, alone = len(rows) - (twice := case.prepared.copies), case.prepared.perhaps_undelivered
    if once < twice and not alone.any():  # Lincoln-Petersen
        evidence.append(Evidence("copies", NOBODY, twice, once**2 // (4 * twice)))
    # What either of two places has says nothing of what one of them missed.
    merged = alone.any() and not case.capture.astray
    fair = (item for item in evidence if not (merged and item.kind == "periods"))
    return Quality(tuple(fair), case.capture.drops)


def _identifications(case: Case) -> Iterator[Evidence]:
    """Yield for each sender and receiver the identifications between two captured ones (rule 1)."""
    rows, hosts = case.rows, case.instances.hosts
    own = np.flatnonzero((rows.identification != 0) & ~rows.streamed)
    _, pair = numbered(hosts.take(rows.source[own]), hosts.take(rows.destination[own]))
    for _, members in by_value(pair):
        mine = own[members]
        counts = _between(rows.time_ns[mine], rows.identification[mine])
        yield Evidence("identifications", int(hosts[rows.source[mine[0]]]), *counts)


def _between(time_ns: Integers, identification: NDArray[np.uint16]) -> tuple[int, int]:
    """Return the numbers of even identifications (checked, missing) with both neighbours within a tick."""
    run = np.concatenate(([0], np.cumsum(np.diff(time_ns) >= _TICK_NS)))
    ahead = identification.astype(np.int64) - identification[np.flatnonzero(np.diff(run, prepend=-1))][run]
    ahead = (ahead + (1 << 15)) % (1 << 16) - (1 << 15)
    odd, key = identification % 2 == 1, (run << 16) + ahead
    if (key[1:] < key[:-1]).any():  # packets of two senders on one host may overtake each other
        order = np.argsort(key, kind="stable")
        run, ahead, time_ns, odd = run[order], ahead[order], time_ns[order], odd[order]
    different = np.concatenate(([True], (np.diff(ahead) != 0) | (np.diff(run) != 0)))
    run, ahead, time_ns, odd = run[different], ahead[different], time_ns[different], odd[different]

    def both(places: int) -> int:
        """Count pairs of odd numbers that follow each other, ``places`` rows apart, within a tick."""
        near = (run[places:] == run[:-places]) & (np.abs(time_ns[places:] - time_ns[:-places]) < _TICK_NS)
        return int((near & odd[:-places] & (ahead[places:] - ahead[:-places] == 2)).sum())

    captured, missing = both(2), both(1)
    return captured + missing, missing


def _inputs(case: Case) -> Iterator[Evidence]:
    """Yield for each stream into cFS the messages made from its commands (rule 2)."""
    rows = case.rows
    best: dict[Stream, Evidence] = {}
    for members in by_key(case.hops, lambda hop: hop.out.way).values():
        longest_ns = max(hop.last_ns for hop in members)
        leaving = distinct(np.concatenate([hop.out.rows for hop in members]))
        sole, captured = np.zeros((2, len(leaving)), bool)
        for hop in members:
            place = np.searchsorted(leaving, hop.out.rows)
            sole[place] |= hop.sole & (hop.single.sum() >= _MOSTLY_ONCE * max(len(hop.single), 1))
            captured[place] |= hop.origin >= 0
        when = rows.time_ns[leaving]
        early = when - case.start_ns <= _START_NS + 2 * longest_ns
        usable = sole & ~early & ~overlapping(when - longest_ns - _START_NS, when, case.all_holes)
        # Another application may publish this MsgId too: lengths that no command makes are of its packets.
        usable &= np.isin(rows.length[leaving], rows.length[leaving[captured]])
        if usable.any() and captured[usable].mean() >= _ALIKE:
            into = members[0].into
            sender = int(case.instances.hosts[rows.source[into.rows[0]]])
            evidence = Evidence("inputs", sender, int(usable.sum()), int((usable & ~captured).sum()))
            # A stream whose messages come out on several ways is checked by one of these.
            if evidence.checked > (best[into].checked if into in best else 0):
                best[into] = evidence
    yield from best.values()


def _ci_counts(case: Case) -> Iterator[Evidence]:
    """Yield for each CI the datagrams that it counted between two times with an empty socket (rule 3)."""
    rows, to_ci, instances, samples = case.rows, case.to_ci, case.instances, case.payloads.ingest
    whose = instances.of_row[samples["row"]]
    own = np.flatnonzero(whose != NOBODY)
    systems = instances.system_of_row[samples["row"][own]]
    host_of = np.array([*(item.host for item in instances.items), NOBODY])[whose[own]]
    for host, places in by_value(host_of):
        mine = to_ci[instances.hosts[rows.destination[to_ci]] == host]
        if len(np.unique(systems[places])) > 1 or len(np.unique(rows.destination[mine])) != 1:
            continue
        part = own[places]
        made_ns = instances.made_ns[samples["row"][part]]
        order = np.argsort(made_ns, kind="stable")
        made_ns, part = made_ns[order], part[order]
        total = samples["packets"][part] + samples["errors"][part]
        totals, captured = _rests(rows.time_ns[mine], made_ns, total, case.all_holes)
        if len(totals) and (captured <= totals).all():
            sender = int(np.bincount(instances.hosts[rows.source[mine]]).argmax())
            yield Evidence("ci_counts", sender, int(totals.sum()), int((totals - captured).sum()))


def _rests(
    sent_ns: Integers, made_ns: Integers, total: Integers, holes: Sequence[tuple[int, int]]
) -> tuple[Integers, Integers]:
    """Return the datagrams counted by CI, and captured, between samples with an empty socket: i64 each.

    Args:
        sent_ns: times of the datagrams to this CI, in order.
        made_ns: times of the samples, in order.
        total: count of CI at each sample.
        holes: spans (start, end), ns, in which nothing was captured.
    """
    before = np.searchsorted(sent_ns, made_ns - _REST_NS)
    # The socket is empty if CI read, since its last sample, as many datagrams as arrived.
    usual = np.diff(total, prepend=total[:1]) == np.diff(before, prepend=before[:1])
    rest = np.flatnonzero(usual & (before == np.searchsorted(sent_ns, made_ns + _LATE_NS)))
    # If the count equals the number captured so far, CI counted from the first captured datagram on.
    start = rest[(total[rest] == before[rest]) & (before[rest] >= _LEAST_COUNTED)][-1:]
    if len(start):
        return total[start], before[start]
    totals, captured = np.diff(total[rest]), np.diff(before[rest])
    usable = (totals >= 0) & (np.diff(made_ns[rest]) > 0)
    usable &= ~overlapping(made_ns[rest][:-1] - _REST_NS, made_ns[rest][1:], holes)
    return totals[usable], captured[usable]


def _sequence_counts(case: Case) -> Iterator[Evidence]:
    """Yield for each stream the sequence counts while the bus counted no loss (rule 4)."""
    instances = case.instances
    for stream in case.streams:
        track = case.tracks.get(stream.instance)
        if not (stream.counted and stream.link.from_cfs and track and len(track.times) > 1):
            continue
        own = stream.rows
        made_ns, missing = instances.made_ns[own], stream.missing[:-1]
        few = np.flatnonzero(missing <= _MOST_MISSING)
        steps = missing[few] + 1
        of, place, whole = np.repeat(few, steps), places_within(steps) + 1, np.repeat(steps, steps)
        when = made_ns[of] + (made_ns[of + 1] - made_ns[of]) * place // whole
        absent = place < whole
        start_ns, end_ns = when - _ROUNDS_NS, when + _ROUNDS_NS
        usable = _quiet(track, start_ns, end_ns) & ~overlapping(start_ns, end_ns, case.all_holes)
        sender = int(instances.hosts[case.rows.source[own[0]]])
        yield Evidence("sequence_counts", sender, int(usable.sum()), int((usable & absent).sum()))


def _periods(case: Case) -> Iterator[Evidence]:
    """Yield for each stream into cFS with an even rate its periods, and those without a message (rule 5)."""
    hosts, holes = case.instances.hosts, case.all_holes
    for stream in case.streams:
        for span in () if stream.link.only_from_cfs else stream.spans:
            times = stream.time_ns[span.rows]
            steps = np.diff(times)
            for usual in (np.median, _local_medians) if len(steps) >= _LEAST_COUNTED else ():
                period = np.maximum(usual(steps), 1)
                periods = np.rint(steps / period)
                even = (periods >= 1) & (np.abs(steps - periods * period) <= _EVEN * period)
                if even.mean() >= _MOSTLY_ONCE:
                    valid = even & (periods <= _MOST_PERIODS) & ~overlapping(times[:-1], times[1:], holes)
                    valid &= np.append(periods[1:], 1) > 0  # else the sender was late
                    passed, sender = int(periods[valid].sum()), int(hosts[case.rows.source[stream.rows[0]]])
                    yield Evidence("periods", sender, passed, passed - int(valid.sum()))
                    break


def _local_medians(values: Integers) -> Integers:
    """Return about the median of each value and the four on each side of it, i64 (n,)."""
    for apart in (1, 3):
        wide = np.pad(values, apart, mode="symmetric")
        before, after = wide[: -2 * apart], wide[2 * apart :]
        values = np.clip(values, np.minimum(before, after), np.maximum(before, after))
    return values


def _quiet(track: Track, start_ns: Integers, end_ns: Integers) -> Mask:
    """Return in which spans the bus counters did not grow, by a sample on either side: bool (n,)."""
    times = np.array(track.times, np.int64)
    lost = np.array(track.totals["pipe_overflows"]) + np.array(track.totals["msg_limits"])
    low = np.searchsorted(times, start_ns, "right") - 1
    high = np.searchsorted(times, end_ns)
    inside = (low >= 0) & (high < len(times))
    return np.asarray(inside & (lost[np.maximum(low, 0)] == lost[np.minimum(high, len(times) - 1)]))


def overlapping(start_ns: Integers, end_ns: Integers, holes: Sequence[tuple[int, int]]) -> Mask:
    """Return which times overlap one of the spans ``holes``, ns: bool (n,)."""
    out = np.zeros(len(start_ns), bool)
    for begin, end in holes:
        out |= (start_ns < end) & (end_ns > begin)
    return out


def least_runs(case: Case, numbers: Mapping[Stream, int]) -> int:
    """Return how few runs of missing frames can have caused all gaps of some streams, but for holes.

    Up to ``_MOST_RUNS`` are looked for; what these leave open counts as one run each. A stream with as many
    gaps of other causes as the ``numbers`` to explain does not show the runs.
    A run lies between two captured frames, so it can be in all gaps that contain both. A sender goes on in a
    gap: it sends in each round of Telemetry Output, or as evenly as the number of missing messages allows.
    """
    round_ns, times, spans = case.profile.to_wake_ns, case.rows.time_ns, [np.zeros((2, 0), np.int64)]
    for stream, number in numbers.items():
        missing = stream.missing[:-1] * ~overlapping(stream.time_ns[:-1], stream.time_ns[1:], case.all_holes)
        at = np.flatnonzero(missing * (2 * number > missing.sum()))
        start, end = stream.time_ns[at], stream.time_ns[at + 1]
        points = np.minimum(stream.missing[at], (end - start) // round_ns + 1)
        of = np.repeat(np.arange(len(at)), points)
        step = ((end - start) // (points + 1))[of]
        due = start[of] + step * (places_within(points) + 1)
        slack = np.where(points[of] > 1, round_ns, step)
        spans.append(np.stack((np.maximum(start[of], due - slack), np.minimum(end[of], due + slack))))
    low, high = np.concatenate(spans, axis=1)
    low, high, runs = np.searchsorted(times, low, "right") - 1, np.searchsorted(times, high), 0
    while len(high) and runs < _MOST_RUNS:  # each run is as late as the gap that ends first allows
        runs, others = runs + 1, (low >= high.min()) & (high > high.min())
        low, high = low[others], high[others]
    return runs + len(high)


def fewest_runs(low: Places, high: Places, number: int) -> int:
    """Return how few runs of missing frames can have taken a number of messages, any of some; at most 32.

    Args:
        low: last captured frame before each message that can be missing.
        high: first captured frame behind it.
        number: how many of them are missing.
    """
    runs = 0
    while number > 0 and runs < _MOST_RUNS and len(low):
        begins = np.sort(low)
        together = np.searchsorted(begins, begins, "right") - np.searchsorted(np.sort(high), begins, "right")
        at, runs, number = begins[together.argmax()], runs + 1, number - int(together.max())
        others = (low > at) | (high <= at)
        low, high = low[others], high[others]
    return runs


def binomial_tail(missing: int, checked: int, share: float) -> float:
    """Return the probability of at most ``missing`` misses in ``checked`` trials of probability ``share``."""
    if share <= 0 or missing >= checked:
        return 1.0
    if share >= 1:
        return 0.0
    reach = int(_DEVIATIONS * sqrt(checked * share * (1 - share))) + _DEVIATIONS * _DEVIATIONS
    if missing > checked * share + reach:
        return 1.0
    top = lgamma(checked + 1) - lgamma(missing + 1) - lgamma(checked - missing + 1)
    top += missing * log(share) + (checked - missing) * log1p(-share)
    # Each term follows from the one above it; terms further down are smaller than the last digit.
    lower = np.arange(missing, max(missing - 2 * reach, 0), -1)
    ratios = np.log(lower) - np.log(checked - lower + 1) + log1p(-share) - log(share)
    return min(1.0, float(np.exp(top + np.cumsum(ratios)).sum()) + exp(top))


@cache
def largest_share(checked: int, missing: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper end of the one-sided Clopper-Pearson interval for the missing share, 0 to 1."""
    low, high = missing / max(checked, 1), 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        is_likely = binomial_tail(missing, checked, middle) > 1 - confidence
        low, high = (middle, high) if is_likely else (low, middle)
    return high


@cache
def largest_number(count: int, checked: int, missing: int, confidence: float = CONFIDENCE) -> int:
    """Return how many of ``count`` unchecked datagrams can be missing, by Fisher's exact test.

    If datagrams are missed at random, the missing ones spread over checked and unchecked datagrams in
    proportion. The result is the largest number that the confidence does not exclude.
    """
    tail = partial(hypergeometric_tail, missing, checked, count)
    return bisect_left(range(1, count + 1), True, key=lambda most: tail(most + missing) < 1 - confidence)


def hypergeometric_tail(most: int, checked: int, others: int, drawn: int) -> float:
    """Return the probability of at most ``most`` checked datagrams in a draw without replacement.

    Args:
        most: largest number of checked datagrams among those drawn.
        checked: number of checked datagrams.
        others: number of unchecked datagrams.
        drawn: number of datagrams drawn from both.
    """

    def ways(of: int, number: int) -> float:
        return lgamma(of + 1) - lgamma(number + 1) - lgamma(of - number + 1)

    least, top = max(0, drawn - others), min(most, checked, drawn)
    if top < least:
        return 0.0
    highest = ways(checked, top) + ways(others, drawn - top) - ways(checked + others, drawn)
    number = np.arange(top, least, -1)  # each term follows from the one above it
    more = np.log(number) + np.log(others - drawn + number)
    ratios = more - np.log(checked - number + 1) - np.log(drawn - number + 1)
    return exp(highest) + float(np.exp(highest + np.cumsum(ratios)).sum())


_LEAST_NS: Final = 1500 * MILLISECOND
"""Telemetry Output wakes up three times in this time."""
_ROUND_NS: Final = 500 * MILLISECOND
_AROUND_NS: Final = 30 * SECOND
_IDLE_NS: Final = SECOND
_LEAST_ROWS: Final = 2
_LEAST_STREAMS: Final = 3
"""Least number of missing packets for a hole, and of streams that miss some for a certain hole."""
_MOST: Final = 64
"""Largest number of holes that are looked for; the longest gaps come first."""


def find_holes(rows: Rows) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return the certain holes of a capture, then the possible ones (rules 13 to 16): (start, end) in ns.

    Args:
        rows: table of datagrams, in order of time.
    """
    steps = np.diff(rows.time_ns)
    long = np.flatnonzero(steps >= _ROUND_NS)
    if not len(long):
        return [], []
    long = np.sort(long[np.argsort(-steps[long], kind="stable")[:_MOST]])
    counted = np.flatnonzero(rows.counted & rows.on(lambda link: link.from_cfs))
    keys = (rows.link, rows.source, rows.destination, rows.processor_id, rows.msg_id)
    _, which = numbered(*(key[counted].astype(np.int64) for key in keys))
    streams = [counted[members] for _, members in by_value(which)]
    commands = rows.time_ns[rows.on(lambda link: link.only_to_cfs)]
    network = np.flatnonzero(rows.on(lambda link: link.peers))
    peers = [rows.time_ns[own] for _, own in groups(rows.sbn_sender(), network)]
    holes: tuple[list[tuple[int, int]], ...] = [], []
    for gap in zip(rows.time_ns[long].tolist(), rows.time_ns[long + 1].tolist(), strict=True):
        others = _steady(commands, *gap) or sum(_steady(times, *gap) for times in peers) > 1
        missing, number, packets = _missing_at(rows, streams, gap[0])
        most = missing >= _LEAST_STREAMS and 2 * missing > number
        if packets >= _LEAST_STREAMS and (most or gap[1] - gap[0] >= _LEAST_NS):
            holes[not (others and most)].append(gap)
    return holes[0], holes[1]


def _steady(times: Integers, start_ns: int, end_ns: int) -> bool:
    """Return whether a sender was active around a span, with a period much shorter than the span."""
    before = times[(times > start_ns - _AROUND_NS) & (times <= start_ns)]
    after = times[(times > start_ns) & (times < end_ns + _AROUND_NS)]
    if min(len(before), len(after)) < _LEAST_ROWS:
        return False
    usual = np.quantile(np.concatenate((np.diff(before), np.diff(after))), 0.9)
    idle = max(start_ns - int(before[-1]), int(after[0]) - end_ns)
    return bool(1.5 * usual < end_ns - start_ns and idle <= max(3 * usual, _IDLE_NS))


def _missing_at(rows: Rows, streams: Sequence[Places], start_ns: int) -> tuple[int, int, int]:
    """Return three numbers at a time: streams with missing counts, all streams, and missing packets."""
    enough = [own for own in streams if len(own) > _LEAST_ROWS]
    behind = [(own, int(np.searchsorted(rows.time_ns[own], start_ns, "right"))) for own in enough]
    missing = [int(rows.missing[own[at]]) for own, at in behind if 0 < at < len(own)]
    return sum(map(bool, missing)), len(missing), sum(missing)


class HostDrops(NamedTuple):
    """Increases of the kernel's counters during a capture.

    Attributes:
        by_port: UDP port to datagrams that its full socket dropped; only ports with drops.
        reassembly_failures: IP packets that could not be put together from their fragments.
        interface_drops: frames that interfaces dropped on receipt.
        ports: UDP ports with an open socket.
    """

    by_port: dict[int, int]
    reassembly_failures: int = 0
    interface_drops: int = 0
    ports: frozenset[int] = frozenset()


def host_drops(readings: Sequence[HostCounters], start_ns: int, end_ns: int) -> HostDrops:
    """Return the kernel's drops between two times, from the readings closest around them.

    Args:
        readings: readings of the counters, oldest first.
        start_ns: begin, ns since 1970; the last reading at or before it is the base.
        end_ns: end, ns since 1970; the first reading at or after it is the last one used.
    """
    before = [item for item in readings if item.time_ns <= start_ns] or list(readings[:1])
    after = next((at for at, item in enumerate(readings) if item.time_ns >= end_ns), len(readings) - 1)
    used = [item for item in readings[: after + 1] if item.time_ns >= before[-1].time_ns] if before else []
    if not used:
        return HostDrops({})
    first = {item.inode: item.drops for item in used[0].sockets}
    last = {item.inode: item for reading in used for item in reading.sockets}
    dropped: Counter[int] = Counter()
    for inode, item in last.items():
        dropped[item.port] += max(0, item.drops - first.get(inode, 0))

    def increase(name: str) -> int:
        values = [value for item in used if (value := getattr(item, name)) is not None]
        return max(0, values[-1] - values[0]) if values else 0

    drops = {port: count for port, count in sorted(dropped.items()) if count}
    ports = frozenset(item.port for item in last.values())
    return HostDrops(drops, increase("reassembly_failures"), increase("interface_drops"), ports)
