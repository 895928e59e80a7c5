"""Telemetry Output was sent elsewhere by somebody else than who enabled it."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.rules.to_destination import is_address
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import OutputCommand

ID = "to_taken_over"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every enable command that takes the telemetry away from whom another host enabled it for."""
    rows = case.rows
    by_target: dict[int, list[OutputCommand]] = {}
    for item in case.payloads.output:
        if item.function_code == telemetry_output.ENABLE and rows.link[item.row] == CI:
            by_target.setdefault(int(rows.destination[item.row]), []).append(item)
    for members in by_target.values():
        enables = [item for item in members if is_address(item.address)]
        for before, after in pairwise(enables):
            old, new = (case.endpoints[rows.source[item.row]].address for item in (before, after))
            if before.address == after.address or old == new:
                continue
            time_ns = int(rows.time_ns[after.row])
            yield Verdict(
                ID,
                Severity.SECURITY,
                f"{new} had all telemetry sent to {after.address}; {before.address}, for which {old} had "
                "enabled it, gets none from then on",
                msg_id=case.of_known(telemetry_output.COMMAND_MSG_ID),
                link="to",
                hop=telemetry_output.NAME,
                start_ns=time_ns,
                end_ns=time_ns,
                evidence=(
                    f"packet {rows.number[after.row]} at {case.at(time_ns)}",
                    f"before: packet {rows.number[before.row]} at {case.at(int(rows.time_ns[before.row]))}",
                ),
                remedy="let only the station reach CI's port, and enable TO again",
            )
