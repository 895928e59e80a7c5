"""Commands with names: ``edoras inject`` sends them by name, and the doctor recommends them.

A name consists of the application and the command, like ``es-stop-app``; arguments are given by name or in
order. :data:`NAMED` has the commands that are bare headers, and short forms of some with one argument.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from enum import Enum
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.cfs import event_services, executive_services, sbn, telemetry_output
from edoras_tools.cfs.arguments import ARGUMENTS, DEFAULTS, SERVICES, TAILS
from edoras_tools.cfs.names import COMMANDS, MSG_ID_NAMES
from edoras_tools.errors import ConfigError
from edoras_tools.words import either

if TYPE_CHECKING:
    from edoras_tools.wire.layout import Field

_HIGHEST: Final = 0xFFFF
_HEADER_BYTES: Final = 8
_RESETS: Final = {"processor": 1, "power_on": 2}


class Argument(Enum):
    """The argument of a command; the value is its description for the user."""

    NONE = "no argument"
    MSG_ID = "a MsgId"
    APP = "the name of an application, as events print it"
    START = "the name of an application, or NAME,FILE,ENTRY[,PRIORITY[,STACK]] as cfe_es_startup.scr has them"
    RESET = "processor or power_on"


class NamedCommand(NamedTuple):
    """A command.

    Attributes:
        msg_id: MsgId of its application.
        function_code: its number there.
        argument: argument that it takes.
    """

    msg_id: int
    function_code: int
    argument: Argument = Argument.NONE

    @property
    def has_limit(self) -> bool:
        """Whether it also takes a message limit of its MsgId."""
        return (self.msg_id, self.function_code) == (
            telemetry_output.COMMAND_MSG_ID,
            telemetry_output.ADD_PACKET,
        )

    def payload(self, text: str, limit: int) -> bytes:
        """Return the bytes of the arguments, little-endian.

        Args:
            text: text of the argument.
            limit: message limit, if it takes one.

        Raises:
            ConfigError: the argument is not allowed.
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
            return {"stream": number}
        if self.argument is Argument.START:
            return self._start(text)
        if self.argument is Argument.RESET:
            name = text.replace("-", "_")
            if name not in _RESETS:
                raise ConfigError(f"takes {self.argument.value}, not {text!r}")
            return {"restart_type": _RESETS[name]}
        return {"application": text}

    def _start(self, text: str) -> dict[str, int | str]:
        """Return the fields of the command that starts an application."""
        app, *rest = (item.strip() for item in text.split(","))
        if not rest and app not in executive_services.STARTS:
            apps = ", ".join(executive_services.STARTS)
            raise ConfigError(f"knows file and entry point of {apps}; of {app!r} write NAME,FILE,ENTRY")
        file, entry, *numbers = rest if rest[1:] else executive_services.STARTS.get(app, ("", ""))
        values = [executive_services.USUAL_PRIORITY, executive_services.USUAL_STACK_BYTES]
        values[: len(numbers)] = [_number(item) for item in numbers]
        if len(rest) == 1 or len(values) > 2 or not (0 < values[0] < 256 and 0 < values[1] < 1 << 32):
            raise ConfigError(f"takes {self.argument.value}, not {text!r}")
        names = {"application": app, "entry_point": entry, "file_name": file}
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
"""Commands by name; ``to-enable`` and ``noop`` are handled separately: their arguments differ in kind."""
ENABLE_OUTPUT: Final = "to-enable"


CALLS: Final[dict[str, tuple[int, int]]] = {
    f"{SERVICES[msg_id][0]}-{layout.title.lower().replace('_', '-')}": (msg_id, code)
    for (msg_id, code), layout in ARGUMENTS.items()
}
"""Every command of the table of arguments by name: MsgId of version 1 and function code."""
_TAIL: Final = "tail"
_MOST: Final = {"microseconds": 999_999}
"""Largest value that cFE accepts, if its field can hold more."""


class CommandArgument(NamedTuple):
    """One argument of a command, as it is typed.

    Attributes:
        name: name before ``=``.
        takes: its range, or its values.
        doc: description with its unit, one line.
        default: value if it is left out; None if it is required.
    """

    name: str
    takes: str
    doc: str
    default: str | None = None


def arguments_taken(name: str) -> list[CommandArgument]:
    """Return the arguments of a command of :data:`CALLS`, in order."""
    key = CALLS[name]
    layout, usual = ARGUMENTS[key], _usual(key)
    fields = [slot.field for slot in layout.slots if slot.field.name != "spare"]
    arguments = [
        CommandArgument(
            item.name,
            _takes(item),
            item.doc,
            item.names.get(usual[item.name], str(usual[item.name])) if item.name in usual else None,
        )
        for item in fields
    ]
    tail = TAILS.get((key[0], layout.title))
    if tail:
        arguments.append(
            CommandArgument(_TAIL, f"0 to {tail}", "zeros behind it; cFE 7.0 pads START_APP by 4", "0")
        )
    return arguments


def call(name: str, words: Sequence[str]) -> bytes:
    """Return the bytes of the arguments of a command of :data:`CALLS`, little-endian.

    Args:
        words: arguments as ``NAME=VALUE``, or values alone, in the order of the arguments without a default.

    Raises:
        ConfigError: an argument is missing or unknown, or its value is not allowed.
    """
    key = CALLS[name]
    layout, arguments = ARGUMENTS[key], arguments_taken(name)
    values: dict[str, int | str] = dict(_usual(key))
    missing, tail = [item.name for item in arguments if item.default is None], 0
    for word in words:
        label, text = _split(name, arguments, missing, word)
        if label == _TAIL:
            tail = _whole(name, label, text, 0, TAILS[key[0], layout.title])
        else:
            values[label] = _value(name, layout.by_name[label].field, text)
    if missing:
        item = next(item for item in arguments if item.name == missing[0])
        raise ConfigError(f"{name} needs {item.name}={item.takes}: {item.doc or 'which'}")
    return layout.emit(values) + bytes(tail)


def _split(
    command: str, arguments: Sequence[CommandArgument], missing: list[str], word: str
) -> tuple[str, str]:
    """Return the argument of a word, and its value; the argument is removed from the missing ones."""
    label, equals, text = word.partition("=")
    if not equals:
        if not missing:
            raise ConfigError(f"{command} takes {_listed(arguments)}; what is {word!r}?")
        label, text = missing[0], word
    names = [item.name for item in arguments]
    if label not in names:
        near = get_close_matches(label, names, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(f"{command} takes {_listed(arguments)}, not {label!r}{hint}")
    if label in missing:
        missing.remove(label)
    return label, text


def _usual(key: tuple[int, int]) -> Mapping[str, int]:
    return DEFAULTS.get((key[0], ARGUMENTS[key].title), {})


def _listed(arguments: Sequence[CommandArgument]) -> str:
    return ", ".join(item.name for item in arguments) or "no arguments"


def _takes(field: Field) -> str:
    if field.kind == "text":
        return f"TEXT of 1 to {field.bits // 8 - 1} bytes"
    if field.names:
        return "|".join(field.names.values())
    if field.name in {"stream", "msg_id"}:
        return "MSGID"
    low, high = _range(field)
    return f"{low} to 0x{high:x}" if field.base == 16 else f"{low} to {high}"


def _range(field: Field) -> tuple[int, int]:
    half = 1 << field.bits - 1
    if field.kind == "int":
        return -half, half - 1
    return 0, _MOST.get(field.name, 2 * half - 1)


def _value(command: str, field: Field, text: str) -> int | str:
    """Return a value of an argument; refuse one that its application would not accept."""
    name = field.name
    if field.kind == "text":
        if not 0 < len(text.encode()) < field.bits // 8 or not text.isascii() or not text.isprintable():
            raise ConfigError(f"{command}: {name} takes {_takes(field)}, in ASCII, not {text!r}")
        if name == "address" and not is_address(text):
            raise ConfigError(f"{command}: {name} takes an IPv4 address, as 127.0.0.1, not {text!r}")
        return text
    if field.names:
        numbers = {label: number for number, label in field.names.items()}
        numbers |= {str(number): number for number in field.names}
        text = text.replace("-", "_")
        if text.lower() not in numbers:
            raise ConfigError(f"{command}: {name} takes {either(list(field.names.values()))}, not {text!r}")
        return numbers[text.lower()]
    if name in {"stream", "msg_id"}:
        number = _number(text)
        if not 0 < number <= _HIGHEST:
            raise ConfigError(f"{command}: {name} takes a MsgId, e.g. 0x0827 or SB_HK, not {text!r}")
        return number
    return _whole(command, name, text, *_range(field))


def is_address(text: str) -> bool:
    """Tell whether a text is an IPv4 address."""
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True


def _whole(command: str, name: str, text: str, low: int, high: int) -> int:
    try:
        number = int(text, 0)
    except ValueError:
        number = low - 1
    if not low <= number <= high:
        raise ConfigError(f"{command}: {name} takes a whole number from {low} to {high}, not {text!r}")
    return number


def inject_line(name: str, *arguments: str) -> str:
    """Return the command line that sends a command.

    Raises:
        KeyError: no command has this name.
    """
    if name != ENABLE_OUTPUT:
        NAMED[name]
    return " ".join(("edoras inject", name, *arguments))
