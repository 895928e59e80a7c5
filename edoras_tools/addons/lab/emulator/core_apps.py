"""cFE's own five applications: their names, pipes, MsgIds and the events that a link shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.cfs import event_services, executive_services, software_bus
from edoras_tools.cfs.event_services import EventText, EventType

if TYPE_CHECKING:
    from collections.abc import Mapping


class CoreApp(msgspec.Struct, frozen=True):
    """The differences between the five applications.

    Attributes:
        name: name in events.
        pipe: name of its pipe.
        command: MsgId of its commands.
        request: MsgId of the housekeeping request.
        telemetry: MsgId of its housekeeping packet.
        others: further MsgIds that it subscribes to.
        no_op_id: number of the no-op event.
        no_op_text: start of that event's text; the version follows.
        bad_length_id: number of the event for a command of a wrong length; None if none was ever captured.
        bad_length_msg_id: format of the MsgId in that event.
        bad_code_id: number of the event for a function code that it does not have.
        bad_code_text: text of that event.
        packets: function code to the packet that the command requests: MsgId and payload bytes.
    """

    name: str
    pipe: str
    command: int
    request: int
    telemetry: int
    no_op_id: int
    bad_code_id: int
    bad_code_text: str = "Invalid command code -- ID = 0x{msg_id:X}, CC = {code:d}"
    others: tuple[int, ...] = ()
    no_op_text: str = "No-op Cmd Rcvd:  "
    bad_length_id: int | None = None
    bad_length_msg_id: str = "0x{msg_id:04X}"
    packets: Mapping[int, tuple[int, int]] = msgspec.field(default_factory=dict)

    @property
    def initialized(self) -> EventText:
        """Return the event at the start."""
        short = self.name.removeprefix("CFE_")
        return EventText(self.name, 1, f"cFE {short} Initialized:  {{version}}")

    @property
    def no_op(self) -> EventText:
        """Return the event of a no-op."""
        return EventText(self.name, self.no_op_id, self.no_op_text + "{version}")

    @property
    def bad_code(self) -> EventText:
        """Return the event of an unknown function code."""
        return EventText(self.name, self.bad_code_id, self.bad_code_text, EventType.ERROR)

    @property
    def bad_length(self) -> EventText | None:
        """Return the event of a command that is too short or too long."""
        if self.bad_length_id is None:
            return None
        text = f"Invalid msg length: ID = {self.bad_length_msg_id},  CC = {{code:d}}, Len = {{length:d}}, "
        return EventText(self.name, self.bad_length_id, f"{text}Expected = {{expected:d}}", EventType.ERROR)


CORE: Final = (
    CoreApp(
        *(event_services.NAME, "EVS_CMD_PIPE", 0x1801, 0x1809, 0x0801, 0, 15),
        bad_code_text="Invalid command code -- ID = 0x{msg_id:08x}, CC = {code:d}",
        bad_length_id=43,
        bad_length_msg_id="0x{msg_id:X}",
    ),
    CoreApp(
        *(software_bus.NAME, "SB_CMD_PIPE", 0x1803, 0x180B, 0x0803, 28, 42),
        bad_code_text="Invalid Cmd, Unexpected Command Code {code:d}",
        others=(0x180E,),
        packets={2: (0x080A, 828)},
    ),
    CoreApp(
        *(executive_services.NAME, "ES_CMD_PIPE", 0x1806, 0x1808, 0x0800, 3, 22),
        bad_code_text="Invalid ground command code: ID = 0x{msg_id:X}, CC = {code:d}",
        no_op_text="No-op command:\n ",
        bad_length_id=23,
    ),
    CoreApp(
        *("CFE_TIME", "TIME_CMD_PIPE", 0x1805, 0x180D, 0x0805, 4, 27),
        others=(0x1811, 0x1862),
        packets={2: (0x0806, 200)},
    ),
    CoreApp("CFE_TBL", "TBL_CMD_PIPE", 0x1804, 0x180C, 0x0804, 10, 51),
)
"""The five applications in the order in which they start."""
