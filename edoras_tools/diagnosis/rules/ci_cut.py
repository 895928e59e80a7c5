"""Command Ingest receives into 768 bytes: what is longer is cut there, silently."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.model import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "ci_cut"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every MsgId whose commands are cut."""
    rows = case.rows
    cut = (rows.link == CI) & rows.has(Finding.OVER_CI_BUFFER)
    limit = case.profile.ci_buffer
    for msg_id in np.unique(rows.msg_id[cut]).tolist():
        members = np.flatnonzero(cut & (rows.msg_id == msg_id))
        sizes = rows.length[members]
        of = int(((rows.link == CI) & (rows.msg_id == msg_id)).sum())
        packets = ", ".join(
            f"packet {rows.number[row]} at {case.at(int(rows.time_ns[row]))}: {rows.length[row]:,} bytes"
            for row in members[:4].tolist()
        )
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(members):,} of {of:,} commands on {case.name(msg_id)} are longer than CI's {limit} "
            "bytes: CI cuts them there and accepts them silently",
            msg_id=msg_id,
            topic=case.topic(msg_id),
            link="ci",
            hop="CI_LAB_APP",
            lost=len(members),
            of=of,
            start_ns=int(rows.time_ns[members[0]]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(packets, f"up to {int(sizes.max()):,} bytes; cFS says nothing of it"),
            remedy=f"send less than {limit} bytes a command, header included; or build CI with a larger "
            "buffer",
        )
