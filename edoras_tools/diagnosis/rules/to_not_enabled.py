"""Commands go to CI, and no telemetry comes: Telemetry Output was not enabled, or sends elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.links.to import TO
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "to_not_enabled"
_WAIT_NS: Final = 3 * SECOND


def judge(case: Case) -> Iterator[Verdict]:
    """Look for a ground link with one direction only."""
    rows = case.rows
    commands = np.flatnonzero(rows.link == CI)
    wanted = bool(len(commands)) or bool(case.mission.ground)
    if not wanted or (rows.link == TO).any() or case.end_ns - case.start_ns < _WAIT_NS:
        return
    enables = [item for item in case.payloads.output if item.function_code == telemetry_output.ENABLE]
    evidence = [f"{plural(len(commands), 'command')} to CI, no datagram from Telemetry Output"]
    if enables:
        evidence += [
            f"enabled for {item.address!r} at {case.at(int(rows.time_ns[item.row]))}" for item in enables
        ]
        reason = (
            f"Telemetry Output was enabled for {enables[-1].address!r} and nothing of it is seen here: it "
            "sends elsewhere, or its datagrams do not cross this capture point"
        )
    else:
        reason = "Telemetry Output sends nothing here, and no command in the capture enables it"
    yield Verdict(
        ID,
        Severity.WARNING,
        reason,
        link="to",
        hop="TO_LAB_APP",
        start_ns=case.start_ns,
        end_ns=case.end_ns,
        evidence=tuple(evidence),
        remedy=f"{case.inject(ENABLE_OUTPUT)}; to see telemetry, capture on the host that it is enabled for, "
        "UDP port 1235",
        confidence="medium",
    )
