"""Nobody here checks a command's checksum, and the bridges do not send one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.model import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "checksum"


def judge(case: Case) -> Iterator[Verdict]:
    """Tell of absent ones; wrong ones are told of one by one as bad commands."""
    rows = case.rows
    commands = (rows.link == CI) & (rows.function_code >= 0)
    absent = int((commands & rows.has(Finding.CHECKSUM_ABSENT)).sum())
    if absent:
        of = int(commands.sum())
        yield Verdict(
            ID,
            Severity.HABIT,
            f"{absent:,} of {of:,} commands carry no checksum, as the EDORAS bridges send them; no cFS "
            "application here checks it, so a damaged command is obeyed",
            link="ci",
            hop="ground bridge",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("the checksum byte is 0, and 0 is not right",),
            remedy="none needed on a link that checks for itself; else compute it (0xFF XOR every byte) "
            "and have the application call CFE_MSG_ValidateChecksum",
        )
