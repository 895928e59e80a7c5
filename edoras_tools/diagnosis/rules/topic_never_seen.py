"""A configured topic of which nothing crossed the capture point."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links import table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.model import Link

ID = "topic_never_seen"


def judge(case: Case) -> Iterator[Verdict]:
    """Tell a link that is not in the capture from a topic that is silent on one that is."""
    rows = case.rows
    links = {table.link(code) for code in set(rows.link.tolist())}
    absent: dict[Link, list[str]] = {}
    for index, route in enumerate(case.mission.routes):
        if (rows.route == index).any():
            continue
        if route.link not in links:
            absent.setdefault(route.link, []).append(f"{route.topic} (0x{route.msg_id:04x})")
            continue
        if (rows.msg_id == route.msg_id).any():
            continue  # it is seen, on another link
        who = "the bridge" if route.to_cfs else "cFS"
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{route.topic} (0x{route.msg_id:04x}) is configured on {route.link.label.upper()} and never "
            f"seen, while other traffic of that link is: {who} sends none, or under another MsgId",
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="bridge" if route.to_cfs else "cFS",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=(f"{route.file}:{route.line}: {route.key}",),
            remedy="see that its publisher runs; compare its mid with MsgIds seen and not configured",
            confidence="medium",
        )
    for link, topics in absent.items():
        yield Verdict(
            ID,
            Severity.NOTE,
            f"no datagram of the {link.label.upper()} link is in the capture: what {', '.join(topics)} did "
            "is not observable from here",
            link=link.label,
            hop="capture",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=(f"links seen: {', '.join(sorted(item.label.upper() for item in links)) or 'none'}",),
            remedy=f"capture where the {link.label.upper()} link passes, or on every host and merge "
            "(record -r A -r B)",
        )
