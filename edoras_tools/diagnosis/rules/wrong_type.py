"""A topic's messages do not decode as the type that the mission file names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.errors import EdorasError
from edoras_tools.model import Finding, Link

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case

ID = "wrong_type"
PACKAGES: Final = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
"""Where types that fit are looked for, besides the mission's own."""
USUAL: Final = (
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
)
"""What the EDORAS demos send: likelier than another type of the same shape."""
_MOST: Final = 3
_SHARE: Final = 0.5


def judge(case: Case) -> Iterator[Verdict]:
    """Name the routes, and the types that fit their bytes."""
    rows = case.rows
    for index, bad, count in misread(case):
        route = case.mission.routes[index]
        samples = list(case.samples.get((int(Link(route.link)), route.msg_id), {}).values())
        fits = fitting(case, samples, route.type)
        sizes = ", ".join(str(size) for size in np.unique(rows.cdr_length[bad])[:4].tolist())
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(bad):,} of {count:,} messages on {case.name(route.msg_id)} do not decode as "
            f"{route.type}" + (f"; {' or '.join(fits[:_MOST])} would fit" if fits else ""),
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
    """Yield routes most of whose messages do not decode: index, those rows, of how many."""
    rows = case.rows
    for index in range(len(case.mission.routes)):
        whole = (rows.route == index) & (rows.cdr_length > 0) & ~rows.has(Finding.CAPTURE_CUT)
        bad = np.flatnonzero(whole & rows.has(Finding.CDR_INVALID))
        count = int(whole.sum())
        if len(bad) >= 2 and len(bad) >= _SHARE * count:
            yield index, bad, count


def fitting(case: Case, samples: list[bytes], configured: str) -> list[str]:
    """Return the types that fit to the last byte, the mission's own and the plainest first."""
    types = case.context.types
    if types is None or not samples:
        return []
    own = {route.type for route in case.mission.routes}
    names = [name for name in types.types() if name.startswith(tuple(f"{item}/msg/" for item in PACKAGES))]
    found = []
    for name in sorted({*names, *own} - {configured}):
        try:
            if all(len(types.encode(name, types.decode(name, cdr))) == len(cdr) for cdr in samples):
                found.append(name)
        except EdorasError:
            continue
    return sorted(found, key=lambda name: (name not in own, name not in USUAL, name))[:8]
