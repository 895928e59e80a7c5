"""Commands went in, and nothing that cFS says is in the capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "not_observable"


def judge(case: Case) -> Iterator[Verdict]:
    """Say what cannot be known from here, and which capture point would tell."""
    rows = case.rows
    cut = (rows.known_id == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID) & rows.has(Finding.CAPTURE_CUT)
    if not case.tracks and cut.any():
        yield _verdict(
            case,
            "the capture cut 0x803 off before its counters: how many messages the software bus lost is not "
            "observable from here",
            "capture whole frames, without -s or with -s 0",
        )
        return
    commands = int((rows.link == CI).sum())
    into = int(((rows.link == SBN) & (rows.function_code >= 0)).sum())
    if not commands and not into:
        if not case.tracks and (rows.link == TO).any():
            yield _verdict(
                case,
                "the counters of the software bus (0x803) are not in the capture: loss inside cFS shows "
                "here only where a sequence count has a gap",
                "add 0x803 and 0x808 to Telemetry Output's table",
            )
        return
    if not case.has_telemetry:
        yield _verdict(
            case,
            f"what became of {commands + into:,} messages into cFS is not observable from here: no "
            "telemetry of that cFS is in the capture",
            (
                "capture Telemetry Output's link too (UDP port 1235 on the ground's host): 0x803 counts, "
                "0x808 names"
            ),
        )
    elif not case.tracks:
        yield _verdict(
            case,
            "0x803 is not in the capture: how many messages the software bus lost is not observable from "
            "here",
            f"have Telemetry Output send it: {case.inject('to-add', f'0x{case.of_known(0x0803):04x}')}",
        )


def _verdict(case: Case, reason: str, remedy: str) -> Verdict:
    return Verdict(
        ID,
        Severity.NOTE,
        reason,
        hop="capture",
        start_ns=case.start_ns,
        end_ns=case.end_ns,
        remedy=remedy,
    )
