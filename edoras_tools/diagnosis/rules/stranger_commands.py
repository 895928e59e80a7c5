"""Commands from an address that telemetry never goes to: no ground station of this capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.rules.privileged_commands import privilege, sound_commands
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.to import TO
from edoras_tools.wire.arrays.order import numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case

ID = "stranger_commands"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every such address; silent where the capture shows no telemetry of that cFS."""
    rows = case.rows
    address = np.array([item.address for item in case.endpoints] or [""], object)
    down = rows.link == TO
    stations: dict[str, set[str]] = {}
    sources, destinations = rows.source[down], rows.destination[down]
    ways, _ = numbered(sources, destinations)
    for source, destination in zip(sources[ways].tolist(), destinations[ways].tolist(), strict=True):
        stations.setdefault(address[source], set()).add(address[destination])
    sent = sound_commands(case)
    by_way: dict[tuple[str, str], list[NDArray[np.intp]]] = {}
    first, which = numbered(rows.source[sent], rows.destination[sent])
    for number, row in enumerate(sent[first].tolist()):
        way = address[rows.source[row]], address[rows.destination[row]]
        by_way.setdefault(way, []).append(sent[which == number])
    for (sender, target), parts in by_way.items():
        members = np.sort(np.concatenate(parts))
        known = stations.get(target)
        if not known or sender in known or sender == target:  # the flight host itself is no stranger
            continue
        kinds = members[numbered(rows.msg_id[members], rows.function_code[members])[0]].tolist()
        names = sorted({case.name(int(rows.msg_id[row])) for row in kinds})
        start_ns = int(rows.time_ns[members[0]])
        allowed = {text for row in kinds if (text := privilege(case, row))}
        yield Verdict(
            ID,
            Severity.SECURITY,
            f"{plural(len(members), 'command')} to CI at {target} from {sender}, to which no telemetry of it "
            "goes: CI obeys whoever reaches its port",
            link="ci",
            hop="CI_LAB_APP",
            start_ns=start_ns,
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(
                f"packet {rows.number[members[0]]} at {case.at(start_ns)} is the first",
                f"telemetry goes to {', '.join(sorted(known))}",
                f"MsgIds: {', '.join(names[:6])}" + (", ..." if len(names) > 6 else ""),
                *(f"it could {text}" for text in sorted(allowed)),
            ),
            remedy="if it is a second ground station, nothing; else let only the station reach CI's port "
            "(a firewall, or authentication in front of CI)",
            confidence="medium",
        )
