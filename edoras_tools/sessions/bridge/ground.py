"""A ground bridge towards cFS: it sends commands to Command Ingest, and asks Telemetry Output for telemetry.

=========  ==========================================  =========
state      event                                       next state
=========  ==========================================  =========
asking     telemetry arrives                           hearing
hearing    none arrives for ``SILENCE_NS``             asking
=========  ==========================================  =========

To ask is to send the enable command, then remove-packet and add-packet commands for the packets of the
mission in Telemetry Output's table: every ``ASK_NS`` at first, later every ``SILENCE_NS``, so that a cFS
that starts late or restarts is reached. Telemetry Output's pipe holds four commands of one MsgId between two
wake-ups: more commands are sent in groups, ``STEP_NS`` apart.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import telemetry_output
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.sessions.bridge.packets import PacketWriter

ASK_NS: Final = 2 * SECOND
SILENCE_NS: Final = 10 * SECOND
STEP_NS: Final = SECOND
"""Twice the time between Command Ingest's wake-ups."""
_ASKS: Final = 5
_AT_ONCE: Final = 4
"""Most commands of one MsgId that can wait in Telemetry Output's pipe."""
_ADD: Final = struct.Struct("<IBBBx")
"""MsgId, priority, reliability, message limit."""


class GroundSession:
    """CI and TO of one cFS.

    Args:
        address: IPv4 address that Telemetry Output shall send to; None: send it no commands.
        add: message limit of each MsgId to add to its table.
        now: present time, ns.

    Attributes:
        ready: whether commands may be sent: always True.
        next_ns: time at which ``service`` is due; None for never.
        hearing: whether telemetry arrives.
        asked: number of times that Telemetry Output was asked.
        notes: lines for people; the reader empties the list.
        refused: number of refused datagrams, by reason: always empty, because any sender may be TO.
    """

    def __init__(
        self, writer: PacketWriter, address: str | None, add: Mapping[int, int] | None = None, *, now: int
    ) -> None:
        self.ready = True
        self.hearing = False
        self.asked = 0
        self.notes: list[str] = []
        self.refused: dict[str, int] = {}
        self.next_ns: int | None = None if address is None else now
        self._writer, self._address, self._add = writer, address, dict(add or {})
        self._heard_ns = now
        self._told = False
        self._again_ns = now
        self._bursts: list[list[bytes]] = []

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram; return the start of its space packet, and no answers."""
        self._heard_ns = now
        if not self.hearing:
            self.hearing, self._told = True, False
            self.notes.append("telemetry arrives")
            if self.next_ns is not None and not self._bursts:
                self.next_ns = now + SILENCE_NS
        return 0, []

    def service(self, *, now: int) -> list[bytes]:
        """Command Telemetry Output to send, if no telemetry arrives."""
        if self.next_ns is None or now < self.next_ns:
            return []
        if not self._bursts:
            silent_ns = now - self._heard_ns
            if self.hearing and silent_ns < SILENCE_NS:
                self.next_ns = self._heard_ns + SILENCE_NS
                return []
            if silent_ns >= SILENCE_NS and not self._told:
                self._told = True
                self.notes.append(
                    f"no telemetry for {silent_ns // SECOND} s: is cFS running, does its TO send here? "
                    f"asking again"
                )
            self.hearing = False
            self.asked += 1
            self._again_ns = now + (ASK_NS if self.asked <= _ASKS else SILENCE_NS)
            self._bursts = self._ask()
        burst = self._bursts.pop(0)
        if self._bursts:
            self.next_ns = now + STEP_NS
        else:
            self.next_ns = self._heard_ns + SILENCE_NS if self.hearing else max(self._again_ns, now + STEP_NS)
        return burst

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet: itself."""
        return packet

    def sent(self, *, now: int) -> None:
        """Do nothing: Command Ingest expects no heartbeat."""

    def goodbye(self) -> list[bytes]:
        """Return nothing: Telemetry Output has no command that disables it."""
        return []

    def summary(self) -> dict[str, Any]:
        """Return the session's part of ``bridge --json``."""
        return {"connected": self.hearing, "asked": self.asked}

    def _ask(self) -> list[list[bytes]]:
        assert self._address is not None
        write = self._writer.write
        command = self._writer.of_known(telemetry_output.COMMAND_MSG_ID)
        bursts = [[write(command, self._address.encode("ascii").ljust(16, b"\0"), telemetry_output.ENABLE)]]
        for msg_id, limit in self._add.items():
            if len(bursts[-1]) > _AT_ONCE - 2:
                bursts.append([])
            # TO keeps the old limit of a MsgId that is added twice: it is removed first.
            bursts[-1] += [
                write(command, _ADD.pack(msg_id, 0, 0, 0)[:4], telemetry_output.REMOVE_PACKET),
                write(command, _ADD.pack(msg_id, 0, 0, limit), telemetry_output.ADD_PACKET),
            ]
        return bursts
