"""The kernel's counters of this host, and interfaces that were away, for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from edoras_tools import words
from edoras_tools.render.terminal.text import clean

if TYPE_CHECKING:
    from edoras_tools.model import HostCounters, InterfaceOutage


def host_lines(
    host: HostCounters, links: Mapping[int, str], steal: float | None, advice: Sequence[str]
) -> Iterator[str]:
    """Yield lines on sockets, counters and limits, then the advice.

    Args:
        links: port to the links that use it.
        steal: share of processor time.
        advice: advice, one line each.
    """
    if host.sockets:
        rows = [
            (
                str(item.port),
                links.get(item.port, ""),
                item.address,
                words.size(item.queued),
                f"{item.drops:,}",
            )
            for item in sorted(host.sockets, key=lambda item: (item.port, item.address))
        ]
        head = ("port", "link", "address", "waiting", "dropped")
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        for row in (head, *rows):
            first_columns = f"{row[0]:>{widths[0]}}  {row[1]:<{widths[1]}}  {row[2]:<{widths[2]}}"
            yield f"{first_columns}  {row[3]:>{widths[3]}}  {row[4]:>{widths[4]}}"
    elif host.receive_buffer_errors is None:
        yield "unknown what listens here: this system has no /proc/net that can be read"
    else:
        yield "no program here listens on a UDP port of the links"
    yield ""
    for name, value in (
        ("UDP datagrams dropped by full sockets, of all programs", host.receive_buffer_errors),
        ("IP packets whose fragments did not all come", host.reassembly_failures),
        ("frames dropped by interfaces", host.interface_drops),
        ("net.core.rmem_default", host.rmem_default),
        ("net.core.rmem_max", host.rmem_max),
        ("fs.mqueue.msg_max", host.msg_max),
    ):
        yield f"{words.count(value) if value is not None else '-':>12}  {name}"
    share = f"{steal:.1%}" if steal is not None else "-"
    yield f"{share:>12}  processor time that this machine's host kept (steal)"
    yield from ("", *advice) if advice else ()


def outage_news(outage: InterfaceOutage) -> str:
    """Return the line for an interface that went away, or is back."""
    name = clean(outage.interface)
    if not outage.end_ns:
        return f"{name} is {outage.why}; waiting for it"
    return f"{name} is back; it was away {_lasted([outage])}"


def outage_lines(outages: Sequence[InterfaceOutage]) -> list[str]:
    """Return a line for each interface that was away: how often and how long, and whether it is away now."""
    lines = []
    for name in dict.fromkeys(outage.interface for outage in outages):
        own = [outage for outage in outages if outage.interface == name]
        over = [outage for outage in own if outage.end_ns]
        parts = []
        if over:
            parts.append(f"was away {_lasted(over)}" + (f", {len(over):,} times" if len(over) > 1 else ""))
        if len(own) > len(over):
            parts.append("was not back at the end")
        lines.append(f"{clean(name)} {' and '.join(parts)}")
    return lines


def _lasted(outages: Sequence[InterfaceOutage]) -> str:
    return words.duration(sum(outage.end_ns - outage.start_ns for outage in outages) / 1e9)
