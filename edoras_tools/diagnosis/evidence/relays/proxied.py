"""What a proxy or a replay did to datagrams on purpose, as the recording says; nobody is blamed for it.

1. What it dropped is lost at the proxy: it is not in the recording, and no later hop misses it.
2. If it sent a datagram several times, all but the first are duplicates of that hop.
3. A datagram that it delayed, changed or cut is counted, and continues.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.sessions.faults.fault import Fault

PROXY_HOP: Final = "proxy"
_DROPPED: Final = "dropped"
_TIMES: Final = ("sent ", " times")
_OVERFLOW: Final = "overflow"


@dataclass(slots=True)
class Proxied:
    """What was done to the datagrams of one MsgId on one link, one way.

    Attributes:
        dropped: the datagrams that it dropped, as they came, with their times.
        doubled: how many it sent besides the first.
        others: kind of any other fault to how many datagrams it struck.
        start_ns: when the first was struck.
        end_ns: and the last.
        rules: the rules that struck, as they were written.
    """

    dropped: list[tuple[int, bytes]] = field(default_factory=list)
    doubled: int = 0
    others: Counter[str] = field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    rules: dict[str, None] = field(default_factory=dict)

    def counts(self, *, peers: bool) -> list[int]:
        """Return the sequence counts of what was dropped.

        Args:
            peers: an SBN header stands in front of each packet.
        """
        at = (sbn.HEADER.size if peers else 0) + 2
        return [
            int.from_bytes(data[at : at + 2], "big") % MODULUS
            for _, data in self.dropped
            if len(data) >= at + 2
        ]


UNTOUCHED: Final = Proxied()
RouteWay = tuple[int, bool, int]
"""Code of the link, whether to cFS, and the MsgId."""


def proxied(faults: Sequence[Fault]) -> dict[RouteWay, Proxied]:
    """Return what was done, by link, way and MsgId."""
    found: dict[RouteWay, Proxied] = {}
    gone: dict[tuple[int, int, bytes], Counter[str]] = {}
    for fault in faults:
        item = found.setdefault((fault.link.code, fault.to_cfs, fault.msg_id), Proxied())
        item.start_ns = min(item.start_ns or fault.time_ns, fault.time_ns)
        item.end_ns = max(item.end_ns, fault.time_ns)
        if fault.rule:
            item.rules[fault.rule] = None
        if fault.detail.startswith(_DROPPED) or fault.kind == _OVERFLOW:
            # Of two rules that drop one datagram both are recorded.
            same = gone.setdefault((fault.time_ns, fault.stream, fault.original), Counter())
            before = max(same.values(), default=0)
            same[fault.rule] += 1
            if max(same.values()) > before:
                item.dropped.append((fault.time_ns, fault.original))
        elif fault.detail.startswith(_TIMES[0]) and fault.detail.endswith(_TIMES[1]):
            item.doubled += int(fault.detail[len(_TIMES[0]) : -len(_TIMES[1])]) - 1
        else:
            item.others[fault.kind] += 1
    return found
