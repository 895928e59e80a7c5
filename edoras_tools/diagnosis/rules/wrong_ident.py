"""SUB or UNSUB with another $Id than the receiver's: SBN refuses it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.rules.bad_network_message import answers
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.wire import sbn
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "wrong_ident"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every other $Id, once a sender."""
    rows = case.rows
    found: dict[tuple[int, str], list[int]] = {}
    listed, contents = case.payloads.subscriptions, case.payloads.contents
    other = np.array([item.ident != sbn.IDENT for item in contents], bool)[listed["said"]]
    for row, said in zip(listed["row"][other].tolist(), listed["said"][other].tolist(), strict=True):
        found.setdefault((int(rows.source[row]), contents[said].ident), []).append(row)
    for (source, ident), members in found.items():
        first = members[0]
        start_ns = int(rows.time_ns[first])
        said = answers(case, start_ns, facts.OTHER_IDENT.phrase)
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{plural(len(members), 'subscription message')} of "
            f"{case.network.identity_of.get(source, 'a peer')}: another $Id than cFS's: refused, and its "
            "receive task ends and starts anew",
            link="sbn",
            hop="SBN",
            lost=len(members),
            of=len(members),
            start_ns=start_ns,
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(
                f"packet {rows.number[first]} at {case.at(start_ns)}: {ident!r}, wanted {sbn.IDENT!r}",
                *said,
            ),
            remedy="build bridge and cFS from the same SBN sources, or copy its $Id",
            confidence="high" if said else "medium",
        )
