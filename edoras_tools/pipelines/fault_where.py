"""Filter expressions for the scopes of faults: ``--fault 'drop:0.5,where=linear.x > 0.4'``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode.where import Where
from edoras_tools.model import Datagram, Endpoint, Link

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.fault_lanes import Predicate

_RAW = 101


def compiler(bench: Workbench) -> Callable[[str], Predicate]:
    """Return what compiles filter expressions to predicates on payloads.

    A fault sees payloads only: fields of frames and addresses are those of no datagram in particular.
    """
    ends = {link: _end(link, bench) for link in Link}

    def compile_where(text: str) -> Predicate:
        where = Where(text, bench.columns.context)

        def passes(payload: bytes, link: Link) -> bool:
            datagram = Datagram(
                number=0,
                time_ns=0,
                link_type=_RAW,
                frame=payload,
                payload=payload,
                payload_offset=0,
                original_length=len(payload),
                source=Endpoint("127.0.0.1", 0),
                destination=ends[link],
            )
            return bool(where.judge([bench.dissector.dissect(datagram)])[0])

        return passes

    return compile_where


def _end(link: Link, bench: Workbench) -> Endpoint:
    """Return a destination of this link: a port that no other link claims, where there is one."""
    claims = bench.columns.context.port_links
    alone = np.flatnonzero(claims == 1 << link)
    shared = np.flatnonzero(claims & (1 << link))
    ports = alone if len(alone) else shared
    return Endpoint("127.0.0.1", int(ports[0]) if len(ports) else 0)
