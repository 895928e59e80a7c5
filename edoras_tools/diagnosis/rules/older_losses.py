"""The counters already stood above zero in the first 0x803 of the capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "older_losses"


def judge(case: Case) -> Iterator[Verdict]:
    """Name what is older, so that nobody blames this traffic for it."""
    for instance, track in case.tracks.items():
        limits, overflows = track.older.get("msg_limits", 0), track.older.get("pipe_overflows", 0)
        if limits or overflows:
            yield Verdict(
                ID,
                Severity.NOTE,
                f"{limits + overflows:,} losses that {case.label(instance)} counts are older than its first "
                "0x803 in the capture: start-up, or earlier traffic",
                hop="software bus",
                start_ns=track.times[0],
                end_ns=track.times[0],
                evidence=(
                    (
                        f"the first 0x803, at {case.at(track.times[0])}: MsgLimit {limits:,}, PipeOverflow "
                        f"{overflows:,}"
                    ),
                ),
                remedy="none; not counted as loss of this capture",
            )
