"""Commands that change what the flight software is: applications, processor, tables, files, memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.names import PRIVILEGED, command_name
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.model import Finding
from edoras_tools.wire.arrays.order import numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case

ID = "privileged_commands"
_MOST: Final = 8
"""Senders and times that are named."""
_UNSOUND = Finding.TRUNCATED | Finding.INVALID_MSG_ID | Finding.WRONG_DIRECTION | Finding.LENGTH_MISMATCH


def sound_commands(case: Case) -> NDArray[np.intp]:
    """Return the rows of sound commands to CI, in order of capture."""
    rows = case.rows
    return np.flatnonzero((rows.link == CI) & (rows.function_code >= 0) & ~rows.has(_UNSOUND))


def privilege(case: Case, row: int) -> str:
    """Return what a command allows whoever sends it; nothing for an ordinary one."""
    return PRIVILEGED.get((int(case.rows.msg_id[row]), int(case.rows.function_code[row])), "")


def judge(case: Case) -> Iterator[Verdict]:
    """Name each kind of such command with where it came from, whoever sent it."""
    rows = case.rows
    sent = sound_commands(case)
    first, which = numbered(rows.msg_id[sent], rows.function_code[sent])
    for number, row in enumerate(sent[first].tolist()):
        if not privilege(case, row):
            continue
        msg_id, code, members = int(rows.msg_id[row]), int(rows.function_code[row]), sent[which == number]
        senders = sorted(
            {case.endpoints[source].address for source in np.unique(rows.source[members]).tolist()}
        )
        times = rows.time_ns[members].tolist()
        yield Verdict(
            ID,
            Severity.SECURITY,
            f"{plural(len(members), 'command')} {command_name(msg_id, code)} on {case.name(msg_id)} from "
            f"{_some(senders)}: it can {PRIVILEGED[msg_id, code]}",
            msg_id=msg_id,
            topic=case.topic(msg_id),
            link="ci",
            hop="CI_LAB_APP",
            start_ns=times[0],
            end_ns=times[-1],
            evidence=(
                f"sent at {_some([case.at(when) for when in times])}",
                f"packet {rows.number[members[0]]} is the first",
            ),
            remedy="see that whoever sent it was meant to; CI asks nobody who he is",
        )


def _some(texts: Sequence[str]) -> str:
    """Return the first of some texts, and how many more there are."""
    more = f" and {len(texts) - _MOST} more" if len(texts) > _MOST else ""
    return ", ".join(texts[:_MOST]) + more
