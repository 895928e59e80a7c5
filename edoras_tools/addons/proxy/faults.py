"""Faults in a proxy: decided for many datagrams at once; only datagrams with a fault are copied."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer
from edoras_tools.sessions.faults.machine import HEAD_BYTES, Delivery, FaultMachine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from edoras_tools.model import Link
    from edoras_tools.sessions.faults.fault import Fault

    Send = Callable[[NDArray[np.int64]], None]

_FEW: Final = 4
"""Up to this many datagrams are decided one by one, which is faster."""


class Outbox:
    """Gathers slots to send, in order; datagrams made on the way go into spare slots.

    Args:
        buffer: the slots.
        send: sends the gathered slots.
    """

    def __init__(self, buffer: DatagramBuffer, send: Send) -> None:
        self._buffer, self._send = buffer, send
        self._slots: list[int] = []
        self._spare = SLOTS

    def add(self, slots: Iterable[int]) -> None:
        """Add slots."""
        self._slots.extend(slots)

    def put(self, payload: bytes) -> None:
        """Add a datagram."""
        if self._spare == SLOTS + SPARE:
            self.flush()
        self._buffer.put(self._spare, payload)
        self._slots.append(self._spare)
        self._spare += 1

    def flush(self) -> None:
        """Send the gathered slots."""
        if self._slots:
            self._send(np.array(self._slots, np.int64))
        self._slots.clear()
        self._spare = SLOTS


class FaultStage:
    """Applies a fault machine to datagrams in a buffer.

    Args:
        machine: decides the faults.
        buffer: the slots.
        link: the link of all datagrams.
        note: called with the faults that were applied.
    """

    def __init__(
        self, machine: FaultMachine, buffer: DatagramBuffer, link: Link, note: Callable[[list[Fault]], None]
    ) -> None:
        self.machine = machine
        self._buffer, self._link, self._note = buffer, link, note

    def apply(self, slots: NDArray[np.int64], *, to_cfs: bool, now: int, stream: int, send: Send) -> None:
        """Send the datagrams in some slots after applying faults.

        Args:
            slots: indices of the slots.
            to_cfs: the direction of the datagrams.
            now: ns since 1970.
            stream: number of the client.
            send: sends slots; called a few times at most.
        """
        machine, buffer, link = self.machine, self._buffer, self._link
        outbox = Outbox(buffer, send)
        selection = slots.tolist()
        if len(selection) <= _FEW:
            for slot in selection:
                payload = buffer.payload(slot)
                result = machine.apply(payload, link=link, to_cfs=to_cfs, now=now, stream=stream)
                self._take(outbox, slot, payload, result)
            outbox.flush()
            return
        verdicts = machine.decide(
            buffer.slots[slots, :HEAD_BYTES],
            buffer.length[slots],
            lambda index: buffer.payload(selection[index]),
            link=link,
            to_cfs=to_cfs,
            now=now,
            stream=stream,
        )
        if verdicts is None:
            send(slots)
            return
        after = 0
        for index in np.flatnonzero(verdicts.any(axis=0)).tolist():
            outbox.add(selection[after:index])
            after = index + 1
            payload = buffer.payload(selection[index])
            result = machine.strike(
                payload, verdicts[:, index], index, link=link, to_cfs=to_cfs, now=now, stream=stream
            )
            self._take(outbox, selection[index], payload, result)
        outbox.add(selection[after:])
        outbox.flush()

    def _take(
        self, outbox: Outbox, slot: int, payload: bytes, result: tuple[list[Delivery], list[Fault]]
    ) -> None:
        deliveries, faults = result
        for delivery in deliveries:
            if delivery.payload is payload:
                outbox.add((slot,))
            else:
                outbox.put(delivery.payload)
        if faults:
            self._note(faults)
