"""Faults on the way through a proxy: a batch is decided at once, and only what is struck is touched."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.sessions.faults import HEAD_BYTES
from edoras_tools.sources.relay import ROOMS, SPARE, payload_of, stage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from edoras_tools.model import Link
    from edoras_tools.sessions.faults import Delivery, Fault, FaultMachine
    from edoras_tools.sources.relay import Arena

    Emit = Callable[[NDArray[np.int64]], None]

_FEW: Final = 4
"""Up to so many datagrams are decided one by one: that is sooner done."""


class Outbox:
    """Gathers rooms to send, in order; what was made on the way is put into spare rooms.

    Args:
        arena: the rooms.
        emit: sends what was gathered.
    """

    def __init__(self, arena: Arena, emit: Emit) -> None:
        self._arena, self._emit = arena, emit
        self._rows: list[int] = []
        self._spare = ROOMS

    def add(self, rows: Iterable[int]) -> None:
        """Take rooms as they are."""
        self._rows.extend(rows)

    def put(self, payload: bytes) -> None:
        """Take a datagram."""
        if self._spare == ROOMS + SPARE:
            self.flush()
        stage(self._arena, self._spare, payload)
        self._rows.append(self._spare)
        self._spare += 1

    def flush(self) -> None:
        """Send what was gathered."""
        if self._rows:
            self._emit(np.array(self._rows, np.int64))
        self._rows.clear()
        self._spare = ROOMS


class Spoiler:
    """Lets a fault machine at what lies in an arena.

    Args:
        machine: what goes wrong.
        arena: the rooms.
        link: what all datagrams are taken for.
        note: takes what was done.
    """

    def __init__(
        self, machine: FaultMachine, arena: Arena, link: Link, note: Callable[[list[Fault]], None]
    ) -> None:
        self.machine = machine
        self._arena, self._link, self._note = arena, link, note

    def spoil(self, rows: NDArray[np.int64], *, to_cfs: bool, now: int, stream: int, emit: Emit) -> None:
        """Send what faults leave of the datagrams in some rooms.

        Args:
            rows: the rooms.
            to_cfs: which way they go.
            now: ns since 1970.
            stream: number of the session.
            emit: sends rooms; called a few times at most.
        """
        machine, arena, link = self.machine, self._arena, self._link
        outbox = Outbox(arena, emit)
        places = rows.tolist()
        if len(rows) <= _FEW:
            for row in places:
                payload = payload_of(arena, row)
                done = machine.apply(payload, link=link, to_cfs=to_cfs, now=now, stream=stream)
                self._take(outbox, row, payload, done)
            outbox.flush()
            return
        verdicts = machine.decide(
            arena.rooms[rows, :HEAD_BYTES],
            arena.length[rows],
            lambda index: payload_of(arena, places[index]),
            link=link,
            to_cfs=to_cfs,
            now=now,
            stream=stream,
        )
        if verdicts is None:
            emit(rows)
            return
        after = 0
        for index in np.flatnonzero(verdicts.any(axis=0)).tolist():
            outbox.add(places[after:index])
            after = index + 1
            payload = payload_of(arena, places[index])
            done = machine.strike(
                payload, verdicts[:, index], index, link=link, to_cfs=to_cfs, now=now, stream=stream
            )
            self._take(outbox, places[index], payload, done)
        outbox.add(places[after:])
        outbox.flush()

    def _take(
        self, outbox: Outbox, row: int, payload: bytes, done: tuple[list[Delivery], list[Fault]]
    ) -> None:
        deliveries, faults = done
        for delivery in deliveries:
            if delivery.payload is payload:
                outbox.add((row,))
            else:
                outbox.put(delivery.payload)
        if faults:
            self._note(faults)
