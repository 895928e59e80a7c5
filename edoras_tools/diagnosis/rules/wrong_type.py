"""A topic's messages are not of the type that the mission file names: they do not decode, or are too long."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Finding
from edoras_tools.ros.cdr.plan import ROUNDING
from edoras_tools.ros.fitting import types_that_fit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.mission import Route

ID = "wrong_type"
_MOST: Final = 3
_SHARE: Final = 0.5


def judge(case: Case) -> Iterator[Verdict]:
    """Name the routes, and the types that fit their bytes."""
    rows = case.rows
    for index, bad, count in misread(case):
        route = case.mission.routes[index]
        fits = fitting(case, _samples(case, route), route.type)
        sizes = ", ".join(str(size) for size in np.unique(rows.cdr_length[bad])[:4].tolist())
        refused = bool(rows.has(Finding.CDR_INVALID)[bad].any())
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(bad):,} of {count:,} messages on {case.name(route.msg_id)} "
            f"{'do not decode as' if refused else 'are longer than'} {route.type}"
            + (f"; {' or '.join(fits[:_MOST])} would fit" if fits else ""),
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="mission file",
            lost=len(bad),
            of=count,
            start_ns=int(rows.time_ns[bad[0]]),
            end_ns=int(rows.time_ns[bad[-1]]),
            evidence=(
                f"{route.file}:{route.line}: type {route.type}",
                f"CDR of {sizes} bytes",
                *([f"types that fit these bytes: {', '.join(fits)}"] if fits else ()),
            ),
            remedy="name the type that the other side sends; both bridges and the flight application must "
            "agree",
            confidence="high" if fits else "medium",
        )


def misread(case: Case) -> Iterator[tuple[int, NDArray[np.intp], int]]:
    """Yield routes most of whose messages are not of their type: index, those rows, of how many."""
    rows = case.rows
    for index, route in enumerate(case.mission.routes):
        whole = (rows.route == index) & (rows.cdr_length > 0) & ~rows.has(Finding.CAPTURE_CUT)
        bad = np.flatnonzero(whole & rows.has(_misfits(case, route)))
        count = int(whole.sum())
        if len(bad) >= 2 and len(bad) >= _SHARE * count:
            yield index, bad, count


def _misfits(case: Case, route: Route) -> Finding:
    """Return the findings that a message of another type has on a route.

    A few bytes too many may be rounding, where no other type ends at the last of them.
    """
    types, found = case.context.types, Finding.CDR_INVALID | Finding.CDR_TOO_LONG
    if types is None or not types.has(route.type) or types.most_trailing(route.type) > ROUNDING:
        return found
    members = (case.rows.msg_id == route.msg_id) & (case.rows.link == route.link)
    if (members & case.rows.has(Finding.CDR_TRAILING)).any() and fitting(
        case, _samples(case, route), route.type
    ):
        found |= Finding.CDR_TRAILING
    return found


def _samples(case: Case, route: Route) -> list[bytes]:
    return list(case.samples.get((int(route.link), route.msg_id), {}).values())


def fitting(case: Case, samples: list[bytes], configured: str) -> list[str]:
    """Return the other types that fit some messages; the mission's own come first."""
    types = case.context.types
    own = {route.type for route in case.mission.routes}
    found = types_that_fit(types, samples, own) if types is not None else []
    return [name for name in found if name != configured][:8]
