"""A configured MsgId whose type bit does not suit its link, or that travels the other way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.links.to import TO
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "wrong_direction"


def judge(case: Case) -> Iterator[Verdict]:
    """Hold the configured routes against the traffic."""
    rows = case.rows
    for route in case.mission.routes:
        command = case.mission.msg_ids.is_command(route.msg_id)
        against = (route.link is CI and not command) or (route.link is TO and command)
        elsewhere = TO if route.link is CI else CI if route.link is TO else None
        there = np.flatnonzero((rows.link == route.link) & (rows.msg_id == route.msg_id))
        other = (
            np.flatnonzero((rows.link == elsewhere) & (rows.msg_id == route.msg_id))
            if elsewhere is not None
            else there[:0]
        )
        # One stray datagram is a bad command; a route is wrong when it never travels as configured.
        if not against and (not len(other) or len(there)):
            continue
        seen = other if len(other) else there
        if route.link is CI:
            wrong = "configured as a command and it is a telemetry MsgId"
        else:
            wrong = "configured as telemetry and it is a command MsgId"
        if len(other) and not against:
            seen_on = (elsewhere or route.link).name
            wrong = f"configured on {route.link.label.upper()} and seen on {seen_on} only"
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{case.name(route.msg_id)} is {wrong}: commands have the bit "
            f"0x{case.mission.msg_ids.command_bit:04x}, telemetry does not",
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="mission file",
            of=len(seen) or None,
            start_ns=int(rows.time_ns[seen[0]]) if len(seen) else case.start_ns,
            end_ns=int(rows.time_ns[seen[-1]]) if len(seen) else case.end_ns,
            evidence=(
                f"{route.file}:{route.line}: {route.key}",
                f"{plural(len(seen), 'datagram')} of it seen",
            ),
            remedy="list the key under command or telemetry as its MsgId says, or correct its mid",
        )
