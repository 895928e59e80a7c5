"""The public flight bridge sends its subscriptions again every 500 ms, for good."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.diagnosis.words import plural
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "subscription_storm"
_LEAST: Final = 6
_OFTEN_NS: Final = 2 * SECOND


def judge(case: Case) -> Iterator[Verdict]:
    """Find who repeats the same subscription."""
    rows = case.rows
    times: dict[tuple[int, tuple[int, ...]], list[int]] = defaultdict(list)
    for item in case.payloads.subscriptions:
        if rows.sbn_msg_type[item.row] == sbn.MsgType.SUB and item.wanted:
            times[int(rows.source[item.row]), item.wanted].append(int(rows.time_ns[item.row]))
    for source in sorted({source for source, _ in times}):
        own = [when for (who, _), when in times.items() if who == source]
        often = [when for when in own if len(when) >= _LEAST and float(np.median(np.diff(when))) < _OFTEN_NS]
        if not often:
            continue
        total = sum(map(len, often))
        period = float(np.median(np.concatenate([np.diff(when) for when in often])))
        yield Verdict(
            ID,
            Severity.HABIT,
            f"{case.network.identity_of.get(source, 'a peer')} sends its "
            f"{plural(len(often), 'subscription')} again every {period / 1e6:.0f} ms, {total:,} in all: the "
            "public flight bridge does; cFS ignores repeats",
            link="sbn",
            hop="flight bridge",
            start_ns=min(when[0] for when in often),
            end_ns=max(when[-1] for when in often),
            evidence=(f"from {case.endpoints[source]}",),
            remedy="none needed; subscribing once after PROTO would do",
        )
