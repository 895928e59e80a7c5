"""More datagrams reach CI's socket than CI reads: they wait, and then the socket drops them."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Link
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "ci_backlog"
_TOLERATED: Final = 12
"""A wake-up's worth of datagrams may be under way at either end."""
_MODULUS: Final = 1 << 32


def judge(case: Case) -> Iterator[Verdict]:
    """Compare what went to CI with what CI says in 0x884 that it took."""
    rows = case.rows
    by_instance: dict[int, list[tuple[int, int]]] = {}
    for item in case.payloads.ingest:
        instance = int(case.instances.of_row[item.row])
        if (
            instance >= 0
            and rows.link[item.row] == Link.TO
            and instance == case.instances.owner(int(rows.source[item.row]), item.time_ns)
        ):
            made = int(rows.mission_time_ns[item.row]) + case.instances.items[instance].offset_ns
            by_instance.setdefault(instance, []).append((made, item.packets + item.errors))
    commands = rows.link == Link.CI
    ports = np.unique(rows.destination[commands])
    if len(by_instance) != 1 or len(ports) != 1:
        return  # several CI: which counter counts which socket is not known
    samples = next(iter(by_instance.values()))
    sent = np.sort(rows.time_ns[commands])
    taken = [(now - samples[0][1]) % _MODULUS for _, now in samples]
    if any(later < earlier for earlier, later in pairwise(taken)):
        return  # the counters were reset
    came = np.searchsorted(sent, [made for made, _ in samples]) - np.searchsorted(sent, samples[0][0])
    behind = came - np.array(taken)
    worst = int(behind.argmax())
    if behind[worst] <= _TOLERATED:
        return
    left = int(behind[-1])
    seconds = (samples[-1][0] - samples[0][0]) / SECOND
    ceiling = case.profile.ci_datagrams_per_wake * SECOND / case.profile.ci_wake_ns
    yield Verdict(
        ID,
        Severity.WARNING,
        f"CI falls behind: up to {int(behind[worst]):,} datagrams wait in its socket, {left:,} at the end; "
        f"it reads {case.profile.ci_datagrams_per_wake} a wake-up, about {ceiling:.0f}/s, and what the "
        "socket cannot hold is dropped unseen",
        link="ci",
        hop="CI_LAB_APP socket",
        of=int(came[-1]),
        start_ns=samples[0][0],
        end_ns=samples[-1][0],
        evidence=(
            f"0x884: CI took {taken[-1]:,} of {int(came[-1]):,} datagrams sent to it in {seconds:.0f} s",
        ),
        remedy=f"send at most {ceiling:.0f} commands a second in all",
        confidence="medium",
    )
