"""EDORAS messages under a MsgId that no mission file names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.rules.wrong_type import fitting
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links import table
from edoras_tools.model import NO_ROUTE, Finding
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "not_configured"


def judge(case: Case) -> Iterator[Verdict]:
    """Name them, where a mission is given at all: without one nothing is configured."""
    rows = case.rows
    if not case.mission.routes:
        return
    loose = (rows.cdr_length > 0) & (rows.route == NO_ROUTE) & rows.has(Finding.UNKNOWN_MSG_ID)
    for msg_id in np.unique(rows.msg_id[loose]).tolist():
        members = np.flatnonzero(loose & (rows.msg_id == msg_id))
        link = table.link(rows.link[members[0]])
        fits = fitting(case, list(case.samples.get((int(link), msg_id), {}).values()), "")
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{plural(len(members), 'message')} on 0x{msg_id:04x} ({link.label.upper()}) "
            f"{'carries' if len(members) == 1 else 'carry'} an EDORAS envelope, "
            "and no mission file names that MsgId: the bridges ignore it",
            msg_id=msg_id,
            link=link.label,
            hop="mission file",
            start_ns=int(rows.time_ns[members[0]]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(
                f"CDR of {rows.cdr_length[members[0]]} bytes",
                *([f"types that fit: {', '.join(fits[:4])}"] if fits else ()),
            ),
            remedy="add the topic to a mission file, or give that file with -c",
        )
