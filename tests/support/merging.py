"""Captures of one machine each, moved to spacecraft with addresses of their own, and put into one capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import rewriting
from msgspec.structs import replace

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

GROUND = {4: "10.0.0.1", 6: "fd00::1"}
"""By the version of IP."""
TO_CFS = {1234, 2234}
"""Ports where cFS listens: CI and SBN."""
ABOARD = {8080, 8585, 2235}
"""Ports whose both ends are on one machine with cFS: the robot's, and a peer that nobody runs."""


def at_address(path: Path, address: str, shift_ns: int = 0) -> list[rewriting.Udp]:
    """Return the datagrams of a capture, with cFS at an address and all that talks to it on the ground."""

    def moved(item: rewriting.Udp) -> rewriting.Udp:
        ground = GROUND[6 if ":" in address else 4]
        to_cfs, aboard = item.destination[1] in TO_CFS, item.destination[1] in ABOARD
        source, destination = (ground, address) if to_cfs else (address, address if aboard else ground)
        return replace(
            item.at(shift_ns), source=(source, item.source[1]), destination=(destination, item.destination[1])
        )

    return [moved(item) for item in rewriting.datagrams(path)]


def merge(captures: Mapping[str, Path], folder: Path) -> tuple[Path, list[Path]]:
    """Write each capture by itself and all of them in one, all beginning at about the time of the first.

    Args:
        captures: by the address of their cFS.

    Returns:
        the one of all, and those of each.
    """
    begins = [rewriting.datagrams(path)[0].time_ns for path in captures.values()]
    parts = [
        at_address(path, address, begins[0] - begin + place * 37_000_003)
        for place, ((address, path), begin) in enumerate(zip(captures.items(), begins, strict=True))
    ]
    alone = [rewriting.write(folder / f"alone_{place}.pcap", part) for place, part in enumerate(parts, 1)]
    every = sorted((item for part in parts for item in part), key=lambda item: item.time_ns)
    return rewriting.write(folder / "merged.pcap", every), alone
