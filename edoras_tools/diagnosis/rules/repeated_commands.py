"""Commands that repeat bytes which another address sent before: a recording that is sent again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.rules.privileged_commands import sound_commands
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "repeated_commands"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every address that does; bare headers, as a no-op, are the same whoever sends them."""
    rows = case.rows
    sent = sound_commands(case)
    sent = sent[rows.packet_length[sent] > rows.header_length[sent]]
    hosts = {name: index for index, name in enumerate(dict.fromkeys(item.address for item in case.endpoints))}
    host_of = np.array([hosts[item.address] for item in case.endpoints] or [0])
    names = list(hosts)
    _, first, which = np.unique(rows.packet_print[sent], return_index=True, return_inverse=True)
    sender = host_of[rows.source[sent]]
    origin = sender[first[which]]
    repeats = np.flatnonzero(sender != origin)
    for who in np.unique(sender[repeats]).tolist():
        members = sent[repeats[sender[repeats] == who]]
        origins = sorted({names[item] for item in origin[repeats[sender[repeats] == who]].tolist()})
        start_ns, row = int(rows.time_ns[members[0]]), int(members[0])
        earlier = int(sent[first[which[np.searchsorted(sent, row)]]])
        yield Verdict(
            ID,
            Severity.SECURITY,
            f"{plural(len(members), 'command')} from {names[who]} repeat, byte for byte, what "
            f"{', '.join(origins)} sent before: a recording is being sent again",
            link="ci",
            hop="CI_LAB_APP",
            start_ns=start_ns,
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(
                f"packet {rows.number[row]} at {case.at(start_ns)} repeats packet {rows.number[earlier]}",
                f"MsgIds: {', '.join(sorted({case.name(int(rows.msg_id[item])) for item in members}))}",
            ),
            remedy="the bridges' commands carry no count and no time, so that cFS obeys old ones again; let "
            "only the station reach CI's port",
            confidence="medium",
        )
