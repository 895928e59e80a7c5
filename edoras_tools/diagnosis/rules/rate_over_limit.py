"""A route is sent faster than its pipe takes, and nothing in the capture tells what became of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

ID = "rate_over_limit"
_LEAST: Final = 20
_OVER: Final = 1.05


def judge(case: Case) -> Iterator[Verdict]:
    """Hold the rates to CI against the budget, where no counter does it better."""
    for stream in case.streams:
        if stream.link is not CI or len(stream) < _LEAST or stream.known_id in MSG_ID_NAMES:
            continue
        clean, hop, why = limit(CI, stream.msg_id, case.profile, to_cfs=True)
        times = case.rows.time_ns[stream.rows]
        usual = float(np.median(np.diff(times)))
        rate = SECOND / usual if usual > 0 else 0.0
        named = any(loss.msg_id == stream.msg_id and loss.kind == "limit" for loss in case.losses)
        if rate <= clean * _OVER or named or _counted(case, stream):
            continue
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{case.name(stream.msg_id)} is sent at {rate:.1f} Hz, above the {clean:g} Hz that are clean: "
            f"{why}. How many were lost is not observable from here",
            msg_id=stream.msg_id,
            topic=case.topic(stream.msg_id),
            link="ci",
            hop=hop,
            of=len(stream),
            start_ns=int(times[0]),
            end_ns=int(times[-1]),
            evidence=(
                f"{len(stream):,} commands, one every {usual / 1e6:.1f} ms",
                "no counter of 0x803 then",
            ),
            remedy=f"send at most {clean:g} Hz; to know what was lost, capture telemetry too, in whole "
            "frames: TO's link, UDP port 1235, with 0x803 in its table",
            confidence="medium",
        )


def _counted(case: Case, stream: Stream) -> bool:
    middle = int(case.rows.time_ns[stream.rows[len(stream) // 2]])
    return any(track.watches(middle) for track in case.tracks.values())
