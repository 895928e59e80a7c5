"""The telemetry generator (``EDORAS_GEN``): publishes a message at a rate, to measure how many arrive.

``edoras codegen generator`` writes it for a real cFS. Its command: MsgId 0x18F0 (``SimProfile``), function
code 2, payload little-endian: slot u16, MsgId u16, rate u16 (Hz, 0 stops), kind u16
(3 is a PoseStamped in its envelope, all others zeros), length u16 of the message behind the header.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.addons.lab.emulator.scheduler import Receive, SleepUntil, Work
from edoras_tools.cfs.event_services import EventText, EventType
from edoras_tools.cfs.profile import GENERATOR_MSG_ID
from edoras_tools.units import MICROSECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.cfe import function_code_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task

NAME: Final = "EDORAS_GEN"
TASK: Final = "EDORAS_GEN.EDORAS_GEN_T"
COMMAND_MSG_ID: Final = GENERATOR_MSG_ID
SET: Final = 2
_NO_OP_CODE: Final = 0
POSE_STAMPED_KIND: Final = 3
_INITIALIZED: Final = EventText(NAME, 1, "EDORAS_GEN initialized, command MID 0x{msg_id:04X}")
_SLOT_SET: Final = EventText(
    NAME, 2, "EDORAS_GEN slot {slot:d}: MID 0x{msg_id:04X} kind {kind:d} len {length:d} rate {rate:d} Hz"
)
_REFUSED: Final = EventText(NAME, 3, "EDORAS_GEN slot {slot:d} refused: {reason}", EventType.ERROR)
_BAD_COMMAND: Final = EventText(
    NAME, 3, "EDORAS_GEN command refused: function code {code:d}, {length:d} bytes", EventType.ERROR
)
_NO_OP: Final = EventText(NAME, 4, "EDORAS_GEN no-op")
_SLOTS: Final = 8
_LONGEST: Final = 65520
_POSE_BYTES: Final = 100
_COMMAND: Final = struct.Struct("<HHHHH")
_FIRST_NS: Final = 500 * MICROSECOND


def set_command(msg_id: int, rate_hz: int, *, length: int = 100, slot: int = 0, kind: int = 3) -> bytes:
    """Return the payload of the command that starts, changes or (rate 0) stops a slot."""
    return _COMMAND.pack(slot, msg_id, rate_hz, kind, length)


class Generator:
    """The generator application."""

    def __init__(self, cfs: Cfs) -> None:
        self._cfs = cfs
        self._round: dict[int, int] = {}
        cfs.events.register(NAME, now=cfs.scheduler.now)
        self._pipe = cfs.create_pipe("EDORAS_GEN_PIPE", cfs.profile.generator_msg_id)
        cfs.say(_INITIALIZED, msg_id=cfs.profile.generator_msg_id)
        cfs.spawn(self._run())

    def _run(self) -> Task:
        while self._cfs.executive.run_loop(NAME):
            packet = messages.whole_packet((yield Receive(self._pipe)))
            code, payload = function_code_of(packet), packet[8:]
            if code == SET and len(payload) >= _COMMAND.size:
                self._set(*_COMMAND.unpack_from(payload))
            elif code == _NO_OP_CODE:
                self._cfs.say(_NO_OP)
            else:
                length = messages.command_length(len(packet), self._cfs.profile)
                self._cfs.say(_BAD_COMMAND, code=code, length=length)
            yield Work(self._cfs.profile.work_ns)

    def _set(self, slot: int, number: int, rate: int, kind: int, length: int) -> None:
        msg_id = messages.bus_id(number, self._cfs.profile)
        reason = _refusal(slot, msg_id, kind, length) if rate or slot >= _SLOTS else ""
        if reason:
            self._cfs.say(_REFUSED, slot=slot, reason=reason)
            return
        self._round[slot] = self._round.get(slot, 0) + 1
        self._cfs.say(_SLOT_SET, slot=slot, msg_id=msg_id, kind=kind, length=length, rate=rate)
        if rate:
            self._cfs.spawn(self._generate(slot, self._round[slot], msg_id, rate, kind, length))

    def _generate(self, slot: int, turn: int, msg_id: int, rate: int, kind: int, length: int) -> Task:
        cfs = self._cfs
        struct_ = messages.FixedStruct(length, cfs.routes.envelope(msg_id))
        first, count = cfs.scheduler.now + _FIRST_NS, 0
        yield SleepUntil(first)
        while self._round[slot] == turn and cfs.executive.run_loop(NAME):
            if kind == POSE_STAMPED_KIND:
                struct_.put(messages.pose_stamped(cfs.scheduler.now, "world", float(count), 0.0, 0.0))
            cfs.telemetry(msg_id, struct_.data, TASK)
            yield Work(cfs.profile.work_ns)
            count += 1
            yield SleepUntil(first + count * SECOND // rate)


def _refusal(slot: int, msg_id: int, kind: int, length: int) -> str:
    """Return the reason why a slot cannot be set; empty if it can."""
    if slot >= _SLOTS:
        return "there is no such slot"
    if not 0 < msg_id <= cfe.HIGHEST_MSG_ID or VERSION_1.is_command(msg_id):
        return "the MsgId is none of telemetry"
    if length > _LONGEST:
        return "the message is too long"
    return (
        "a PoseStamped does not fit the length" if kind == POSE_STAMPED_KIND and length < _POSE_BYTES else ""
    )
