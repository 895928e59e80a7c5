"""Commands that have a name: what ``edoras inject`` sends by it, and what the doctor tells to send.

A command that consists of a header only has the name of its application and its own, as ``es-noop``. The
others here take an argument too.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from edoras_tools.cfs import event_services, executive_services, sbn, telemetry_output
from edoras_tools.cfs.arguments import ARGUMENTS
from edoras_tools.cfs.names import COMMANDS, MSG_ID_NAMES
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

_HIGHEST: Final = 0xFFFF
_HEADER_BYTES: Final = 8
_RESETS: Final = {"processor": 1, "power-on": 2}


class Argument(Enum):
    """What follows the header of a command; the value says it to the user."""

    NONE = "no argument"
    MSG_ID = "a MsgId"
    APP = "the name of an application, as events print it"
    START = "the name of an application, or NAME,FILE,ENTRY[,PRIORITY[,STACK]] as cfe_es_startup.scr has them"
    RESET = "processor or power-on"


@dataclass(frozen=True, slots=True)
class NamedCommand:
    """A command.

    Attributes:
        msg_id: of its application.
        function_code: its number there.
        argument: what it takes.
    """

    msg_id: int
    function_code: int
    argument: Argument = Argument.NONE

    @property
    def has_limit(self) -> bool:
        """Whether it also takes how many messages of its MsgId may wait."""
        return (self.msg_id, self.function_code) == (
            telemetry_output.COMMAND_MSG_ID,
            telemetry_output.ADD_PACKET,
        )

    def payload(self, text: str, limit: int) -> bytes:
        """Return the bytes that follow the header, little-endian.

        Args:
            limit: how many messages may wait, where it takes that.

        Raises:
            ConfigError: the argument is none that it takes.
        """
        if self.argument is Argument.NONE:
            if text:
                raise ConfigError(f"takes no argument; leave {text!r} out")
            return b""
        values = self._values(text)
        if self.has_limit:
            values["limit"] = limit
        layout = ARGUMENTS[self.msg_id, self.function_code]
        for name, value in values.items():
            if isinstance(value, str):
                slot = layout.by_name[name]
                self._check(value, slot.end - slot.start)
        return layout.emit(values)

    def _values(self, text: str) -> dict[str, int | str]:
        """Return the value of each field."""
        if self.argument is Argument.MSG_ID:
            number = _number(text)
            if not 0 < number <= _HIGHEST:
                raise ConfigError(f"takes {self.argument.value}, e.g. 0x0827, not {text!r}")
            return {"msg_id": number}
        if self.argument is Argument.START:
            return self._start(text)
        if self.argument is Argument.RESET:
            if text not in _RESETS:
                raise ConfigError(f"takes {self.argument.value}, not {text!r}")
            return {"restart_type": _RESETS[text]}
        return {"app_name": text}

    def _start(self, text: str) -> dict[str, int | str]:
        """Return the fields of the command that starts an application."""
        app, *rest = (item.strip() for item in text.split(","))
        if not rest and app not in executive_services.STARTS:
            known = ", ".join(executive_services.STARTS)
            raise ConfigError(f"knows file and entry point of {known}; of {app!r} write NAME,FILE,ENTRY")
        file, entry, *numbers = rest if rest[1:] else executive_services.STARTS.get(app, ("", ""))
        values = [executive_services.USUAL_PRIORITY, executive_services.USUAL_STACK_BYTES]
        values[: len(numbers)] = [_number(item) for item in numbers]
        if len(rest) == 1 or len(values) > 2 or not (0 < values[0] < 256 and 0 < values[1] < 1 << 32):
            raise ConfigError(f"takes {self.argument.value}, not {text!r}")
        names = {"app_name": app, "entry_point": entry, "file_name": file}
        return {**names, "stack_size": values[1], "priority": values[0]}

    def _check(self, text: str, size: int) -> None:
        """Refuse a text that leaves no room for a NUL in its field."""
        if not 0 < len(text.encode()) < size:
            raise ConfigError(f"takes {self.argument.value}, {size - 1} bytes at most, not {text!r}")


def _number(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        return next((msg_id for msg_id, name in MSG_ID_NAMES.items() if name == text.upper()), 0)


def _headers_only() -> Iterator[tuple[str, NamedCommand]]:
    for msg_id, codes in COMMANDS.items():
        app = MSG_ID_NAMES[msg_id].removesuffix("_CMD").lower()
        for code, command in codes.items():
            if _HEADER_BYTES in command.lengths:
                yield f"{app}-{command.name.lower().replace('_', '-')}", NamedCommand(msg_id, code)
    yield "sbn-noop", NamedCommand(sbn.COMMAND_MSG_ID, 0)


_TO, _EVS, _ES = telemetry_output.COMMAND_MSG_ID, 0x1801, executive_services.COMMAND_MSG_ID
NAMED: Final[dict[str, NamedCommand]] = {
    **dict(_headers_only()),
    "to-add": NamedCommand(_TO, telemetry_output.ADD_PACKET, Argument.MSG_ID),
    "to-remove": NamedCommand(_TO, telemetry_output.REMOVE_PACKET, Argument.MSG_ID),
    "evs-reset-filters": NamedCommand(_EVS, event_services.RESET_ALL_FILTERS, Argument.APP),
    "evs-enable-app": NamedCommand(_EVS, event_services.ENABLE_APP, Argument.APP),
    "evs-disable-app": NamedCommand(_EVS, event_services.DISABLE_APP, Argument.APP),
    "es-start-app": NamedCommand(_ES, executive_services.START_APP, Argument.START),
    "es-stop-app": NamedCommand(_ES, executive_services.STOP_APP, Argument.APP),
    "es-restart-app": NamedCommand(_ES, executive_services.RESTART_APP, Argument.APP),
    "es-restart": NamedCommand(_ES, executive_services.RESTART, Argument.RESET),
}
"""By name; ``to-enable`` and ``noop`` are read apart: their arguments are of more than one kind."""
ENABLE_OUTPUT: Final = "to-enable"


def inject_line(name: str, *arguments: str) -> str:
    """Return what to type to send a command.

    Raises:
        KeyError: no command has this name.
    """
    if name != ENABLE_OUTPUT:
        NAMED[name]
    return " ".join(("edoras inject", name, *arguments))
