"""The public flight bridge sends its subscriptions again every 500 ms, for good."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "subscription_storm"
_LEAST: Final = 6
_OFTEN_NS: Final = 2 * SECOND


def judge(case: Case) -> Iterator[Verdict]:
    """Find who repeats the same subscription."""
    rows, listed = case.rows, case.payloads.subscriptions
    lists: dict[tuple[int, ...], int] = {(): 0}
    wanted = [lists.setdefault(item.wanted, len(lists)) for item in case.payloads.contents]
    wants = np.array(wanted, np.int64)[listed["said"]]
    subs = (rows.sbn_msg_type[listed["row"]] == sbn.MsgType.SUB) & (wants > 0)
    row = listed["row"][subs]
    first, which = numbered(rows.source[row], wants[subs])
    for source in np.unique(rows.source[row]).tolist():
        numbers = np.flatnonzero(rows.source[row[first]] == source).tolist()
        own = [rows.time_ns[row[which == number]] for number in numbers]
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
            start_ns=int(min(when[0] for when in often)),
            end_ns=int(max(when[-1] for when in often)),
            evidence=(f"from {case.endpoints[source]}",),
            remedy="none needed; subscribing once after PROTO would do",
        )
