"""The telemetry generator (``EDORAS_GEN``): publishes a message at a rate, to measure how many arrive.

``edoras codegen generator`` writes it for a real cFS. Its command: MsgId 0x18F0 (``SimProfile``), function
code 2, payload little-endian: slot u16, MsgId u16, rate u16 (Hz, 0 stops), kind u16
(3 is a PoseStamped in its envelope, all others zeros), length u16 of the message behind the header.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from edoras_tools.cfs.event_services import EventText
from edoras_tools.cfs.profile import GENERATOR_MSG_ID
from edoras_tools.emulator.messages import FixedStruct, pose_stamped
from edoras_tools.emulator.scheduler import Receive, SleepUntil, Work
from edoras_tools.errors import WireError
from edoras_tools.units import MICROSECOND, SECOND
from edoras_tools.wire.packet import function_code_of, whole_packet

if TYPE_CHECKING:
    from edoras_tools.emulator.cfs import Cfs
    from edoras_tools.emulator.scheduler import Task

NAME: Final = "EDORAS_GEN"
TASK: Final = "EDORAS_GEN.EDORAS_GEN_T"
COMMAND_MSG_ID: Final = GENERATOR_MSG_ID
SET: Final = 2
POSE_STAMPED_KIND: Final = 3
_INITIALIZED: Final = EventText(NAME, 1, "EDORAS_GEN initialized, command MID 0x{msg_id:04X}")
_SLOT_SET: Final = EventText(
    NAME, 2, "EDORAS_GEN slot {slot:d}: MID 0x{msg_id:04X} kind {kind:d} len {length:d} rate {rate:d} Hz"
)
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
            packet = yield Receive(self._pipe)
            payload = whole_packet(packet)[8:]
            if function_code_of(packet) == SET and len(payload) >= _COMMAND.size:
                slot, msg_id, rate, kind, length = _COMMAND.unpack_from(payload)
                self._round[slot] = self._round.get(slot, 0) + 1
                self._cfs.say(_SLOT_SET, slot=slot, msg_id=msg_id, kind=kind, length=length, rate=rate)
                if rate and msg_id < 0x1000:
                    self._cfs.spawn(self._generate(slot, self._round[slot], msg_id, rate, kind, length))
            yield Work(self._cfs.profile.work_ns)

    def _generate(self, slot: int, turn: int, msg_id: int, rate: int, kind: int, length: int) -> Task:
        cfs = self._cfs
        struct_ = FixedStruct(length)
        first, count = cfs.scheduler.now + _FIRST_NS, 0
        yield SleepUntil(first)
        while self._round[slot] == turn and cfs.executive.run_loop(NAME):
            if kind == POSE_STAMPED_KIND:
                try:
                    struct_.put(pose_stamped(cfs.scheduler.now, "world", float(count), 0.0, 0.0))
                except WireError:
                    cfs.print(f"EDORAS_GEN slot {slot}: a PoseStamped does not fit {length} bytes")
                    return
            cfs.telemetry(msg_id, struct_.data, TASK)
            yield Work(cfs.profile.work_ns)
            count += 1
            yield SleepUntil(first + count * SECOND // rate)
