"""Filter expressions that limit faults: ``--fault 'drop:0.5,where=linear.x > 0.4'``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode.filters.filter import Where
from edoras_tools.io.frames.frame_batch import LINKTYPE_RAW
from edoras_tools.model import Datagram, Endpoint, Link

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.scopes import Predicate


def compiler(bench: Workbench) -> Callable[[str], Predicate]:
    """Return a function that compiles filter expressions to predicates on payloads.

    A fault sees only payloads: fields of frames and addresses have arbitrary values.
    """
    ends: dict[Link, Endpoint] = {link: _end(link, bench) for link in bench.columns.context.links}

    def compile_where(text: str) -> Predicate:
        where = Where(text, bench.columns.context)

        def passes(payload: bytes, link: Link) -> bool:
            datagram = Datagram(
                number=0,
                time_ns=0,
                link_type=LINKTYPE_RAW,
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
    """Return a destination that is read as this link: if possible a port that no other link claims."""
    context = bench.columns.context
    shared = np.flatnonzero(context.ports[link])
    alone = [port for port in shared if len(context.claimants[context.claim[port]]) == 1]
    ports = alone or shared
    return Endpoint("127.0.0.1", int(ports[0]) if len(ports) else 0)
