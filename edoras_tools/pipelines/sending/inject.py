"""Messages and commands that are made up, not recorded, and sent once or at a rate.

``arbitrary`` makes messages with a value in every field; the same seed gives the same messages.
"""

from __future__ import annotations

import string
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import edoras_app
from edoras_tools.cfs.commands import CALLS, ENABLE_OUTPUT, NAMED, Argument, arguments_taken, call
from edoras_tools.cfs.telemetry_output import USUAL_LIMIT
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.net.sockets import own_address
from edoras_tools.pipelines.sending.loop import enable_output
from edoras_tools.pipelines.sending.options import LinkReceiver, Receiver, SendOptions
from edoras_tools.pipelines.sending.replay import Encoder, routes_towards, sender_of
from edoras_tools.pipelines.sending.run import Loaded
from edoras_tools.ros.library import PRIMITIVES, STRINGS, MessageField, Shape
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.mission import Mission, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.ros.store import TypeStore
    from edoras_tools.wire.ccsds import MsgIds

_MOST: Final = 1 << 17
"""Maximum random messages that are made before the first is sent; a longer run repeats them."""


class Injection(msgspec.Struct, frozen=True):
    """The injected messages or command.

    Attributes:
        subject: topic, key, or MsgId; or name of a command, e.g. ``to-enable`` or ``noop``.
        values: a message as YAML or JSON, ``@FILE`` with one; or a command's argument.
        words: arguments of a command, each as it was typed; empty: ``values`` is the only one.
        command: a MsgId and a function code, instead of ``subject``.
        payload: bytes after the command header.
        function_code: function code of a message that is sent as a command.
        count: number of messages; 0 for no end.
        every_field_random: use random values, new ones for each message.
        seed: seed of the random values.
        limit: message limit of the MsgId, for ``to-add``; None for the usual one.
    """

    subject: str = ""
    values: str = ""
    command: tuple[int, int] | None = None
    payload: bytes = b""
    function_code: int = edoras_app.SET
    count: int = 1
    every_field_random: bool = False
    seed: int = 0
    limit: int | None = None
    words: tuple[str, ...] = ()


def make(injection: Injection, bench: Workbench, options: SendOptions) -> tuple[Loaded, SendOptions]:
    """Make the packets of an injection.

    Args:
        injection: messages or command.
        bench: provides the topics and the message types.
        options: destination and pace.

    Returns:
        The packets of one pass, and the options with the number of passes that gives ``count``.

    Raises:
        ConfigError: the values are not YAML, or a command does not take this argument.
        FieldError: a value does not fit its field; says which field, and what it accepts.
        RouteError: there is no topic or command of that name, or it does not go to this receiver.
    """
    if isinstance(options.to, LinkReceiver):
        return _on_link(injection, bench, options, options.to)
    packets, passes = _packets(injection, bench, options)
    sender = sender_of(options, bench.mission)
    out = Outgoing.packets(options.to.link, packets, sender=sender, headers=options.headers)
    return Loaded(out), replace(options, passes=passes)


def _on_link(
    injection: Injection, bench: Workbench, options: SendOptions, to: LinkReceiver
) -> tuple[Loaded, SendOptions]:
    """Make messages of another link: each has its own counts, so one pass contains them all."""
    sending, count = to.sending, _in_one_pass(injection.count)
    if sending.packets:
        packets, _ = _packets(injection, bench, replace(options, to=to.carried))
        messages = [item.packet for item in packets] * (count // len(packets))
    elif injection.command or injection.every_field_random:
        raise ConfigError(f"--command and random are for {', '.join(Receiver)}; not for --to {to}")
    else:
        values = _values(injection.values, (dict, list))
        messages = sending.compose(injection.subject, values, count, bench.columns.context)
    times = np.arange(len(messages)) * int(SECOND / options.rates[0][1])
    if sending.renews:
        messages, times = sending.renew(messages, times)
    passes = injection.count // count
    return Loaded(Outgoing.bare(to.link, messages, times)), replace(options, passes=passes, rates=())


def _in_one_pass(number: int) -> int:
    """Return the number of messages in one pass, a divisor of the total; the total 0 means without end."""
    number = number or _MOST
    return number if number <= _MOST else next(n for n in range(_MOST, 0, -1) if number % n == 0)


def _packets(injection: Injection, bench: Workbench, options: SendOptions) -> tuple[list[Packet], int]:
    """Return the packets of one pass, and the number of passes that gives ``count``."""
    if injection.command is not None:
        return [Packet(_command(*injection.command, injection.payload, options.headers))], injection.count
    command = _named_command(injection, bench.mission, options)
    packets = list(_messages(injection, bench, options)) if command is None else [Packet(command)]
    return packets, injection.count // len(packets)


def injection_receiver(injection: Injection, mission: Mission) -> str:
    """Return the receiver of an injection by its route; Command Ingest for commands and unknown names."""
    if injection.command is None:
        for to in Receiver:
            if any(injection.subject in names for names in _all_names(routes_towards(to, mission))):
                return to
    return Receiver.CI


def command_names() -> list[str]:
    """Return the names of commands for ``inject``, e.g. ``to-enable`` and ``es-noop``."""
    return list(dict.fromkeys([ENABLE_OUTPUT, "noop", *NAMED, *CALLS]))


def described_commands(name: str = "") -> str:
    """Return one line for each command; for one command or a common prefix, one line for each argument.

    Raises:
        ConfigError: no command name begins like this.
    """
    names = [item for item in CALLS if item.startswith(name)]
    if not names:
        raise ConfigError(f"no command begins with {name!r}: edoras inject list")
    lines = []
    for item in names:
        arguments = arguments_taken(item)
        if name:
            lines.append(item)
            for argument in arguments:
                usual = "" if argument.default is None else f" (default: {argument.default})"
                lines.append(f"  {argument.name:<17} {argument.takes:<24} {argument.doc}{usual}".rstrip())
        else:
            words = (
                argument.name if argument.default is None else f"[{argument.name}={argument.default}]"
                for argument in arguments
            )
            lines.append(f"{item:<28} {' '.join(words)}".rstrip())
    return "\n".join(lines)


def _named_command(injection: Injection, mission: Mission, options: SendOptions) -> bytes | None:
    """Return the packet of a named command; None if it is not the name of a command."""
    name, argument = injection.subject.lower().replace("_", "-"), injection.values
    if f"{name}-{argument.lower()}" in NAMED:  # "sbn noop" is "sbn-noop"
        name, argument = f"{name}-{argument.lower()}", ""
    if injection.limit is not None and not (name in NAMED and NAMED[name].has_limit):
        raise ConfigError("--limit is of to-add: how many messages of its MsgId may wait")
    if name == ENABLE_OUTPUT:
        assert options.target is not None
        address = argument or own_address(options.target)
        if len(address) > 15 or address.count(".") != 3:
            raise ConfigError(f"to-enable takes an IPv4 address, not {address!r}")
        return enable_output(address, options.headers)
    if name == "noop":
        return _command(_noop(argument, options.headers.msg_ids), 0, b"", options.headers)
    words = injection.words or ((argument,) if argument else ())
    if name in CALLS and (name not in NAMED or len(words) > 1 or any("=" in word for word in words)):
        msg_id, code = CALLS[name]
        words = tuple(_with_msg_id(word, mission) for word in words)
        return _command(options.headers.msg_ids.of_known(msg_id), code, call(name, words), options.headers)
    if name not in NAMED:
        return None
    command = NAMED[name]
    if command.argument is Argument.MSG_ID and any(argument in names for names in _all_names(mission.routes)):
        argument = str(mission.find(argument).msg_id)
    try:
        payload = command.payload(argument, USUAL_LIMIT if injection.limit is None else injection.limit)
    except ConfigError as error:
        raise ConfigError(f"{name} {error}") from None
    msg_id = options.headers.msg_ids.of_known(command.msg_id)
    return _command(msg_id, command.function_code, payload, options.headers)


def _with_msg_id(word: str, mission: Mission) -> str:
    """Return an argument with the MsgId of the topic that it names."""
    label, equals, text = word.partition("=")
    if label in {"stream", "msg_id"} and any(text in names for names in _all_names(mission.routes)):
        text = str(mission.find(text).msg_id)
    return label + equals + text


def _noop(text: str, msg_ids: MsgIds) -> int:
    """Return the MsgId for a no-op: given as a number, or by the name of its app."""
    apps = {name.removesuffix("-noop"): item.msg_id for name, item in NAMED.items() if name.endswith("-noop")}
    app = text.strip().lower()
    if app in apps:
        return msg_ids.of_known(apps[app])
    try:
        return int(app, 0)
    except ValueError:
        problem = f"not {text!r}" if text else "and none is named"
        raise ConfigError(f"noop takes a MsgId or an app ({', '.join(apps)}), {problem}") from None


def _command(msg_id: int, function_code: int, payload: bytes, headers: cfe.Headers) -> bytes:
    return cfe.emit_command(
        msg_id, function_code, payload, sequence_flags=0, with_checksum=False, headers=headers
    )


def _messages(injection: Injection, bench: Workbench, options: SendOptions) -> Iterator[Packet]:
    route = _route(injection.subject, bench.mission, options.to)
    if not bench.types.has(route.type):
        raise RouteError(f"{route.topic}: {bench.types.check(route.type)}")
    encoder = Encoder.of(route, bench, injection.function_code)
    if not injection.every_field_random:
        yield encoder.packet(bench.types.encode(route.type, _values(injection.values)), 0)
        return
    if injection.values:
        raise ConfigError("random sets all values; leave the message out")
    dice = Random(injection.seed)  # noqa: S311  for tests, and reproducible
    for _ in range(_in_one_pass(injection.count)):
        values = arbitrary(bench.types, route.type, dice)
        yield encoder.packet(bench.types.encode(route.type, values), 0)


def _route(name: str, mission: Mission, to: Receiver | LinkReceiver) -> Route:
    """Return the route of that name: the one that goes to the receiver, if there are several."""
    towards = routes_towards(to, mission)
    try:
        route = mission.find(name)
    except RouteError as error:
        topic = "/" + name.removeprefix("/")
        fitting = [item for item in towards if topic == item.topic or name == item.key]
        if len(fitting) == 1:
            return fitting[0]
        if not any(name in item for item in _all_names(mission.routes)):
            raise RouteError(f"{error}; commands with a name: {', '.join(command_names()[:3])} ...") from None
        raise
    if route not in towards:
        existing = ", ".join(item.topic for item in towards) or "none"
        where = next((item for item in Receiver if route in routes_towards(item, mission)), None)
        hint = f"--to {where}" if where else "it comes from cFS"
        raise RouteError(f"{route.topic} does not go to {to}: {hint}; topics that go to {to}: {existing}")
    return route


def _all_names(routes: Sequence[Route]) -> Sequence[tuple[str, ...]]:
    return [
        (item.topic, item.topic.removeprefix("/"), item.key, f"0x{item.msg_id:04x}", f"0x{item.msg_id:x}")
        for item in routes
    ]


def _values(text: str, kinds: tuple[type, ...] = (dict,)) -> Any:
    """Read a message from YAML (or JSON), or from ``@FILE``; an empty text gives all defaults."""
    where = "the message"
    if text.startswith("@"):
        where = text[1:]
        try:
            text = Path(where).read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{where}: cannot be read: {getattr(error, 'strerror', None) or error}"
            ) from None
    if not text.strip():
        return {}
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        values = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        why = getattr(error, "problem", None) or str(error).partition("\n")[0]
        raise ConfigError(f"{where}: is not YAML:{place} {why}; write '{{linear: {{x: 0.5}}}}'") from None
    if not isinstance(values, kinds):
        raise ConfigError(f"{where}: needs fields and values, e.g. '{{linear: {{x: 0.5}}}}', not {values!r}")
    return values


_MOST_ITEMS: Final = 4
_MOST_CHARACTERS: Final = 12
_LETTERS: Final = string.ascii_letters + string.digits + "_"
_REACH: Final = 1000.0
"""Largest absolute floating-point value: all are finite, and of a size that is usual for robots."""


def arbitrary(types: TypeStore, type_name: str, dice: Random) -> dict[str, Any]:
    """Return random values for every field of a type, in the form that ``TypeStore.encode`` takes."""
    return {field.name: _arbitrary_values(types, field, dice) for field in types.fields(type_name)}


def _arbitrary_values(types: TypeStore, field: MessageField, dice: Random) -> Any:
    if field.shape is Shape.SCALAR:
        return _value(types, field, dice)
    most = min(field.size or _MOST_ITEMS, _MOST_ITEMS)
    count = field.size if field.shape is Shape.ARRAY else dice.randint(1, most)
    return [_value(types, field, dice) for _ in range(count)]


def _value(types: TypeStore, field: MessageField, dice: Random) -> Any:
    if field.type in STRINGS:
        most = min(field.string_bound or _MOST_CHARACTERS, _MOST_CHARACTERS)
        return "".join(dice.choices(_LETTERS, k=dice.randint(1, most)))
    if field.type == "bool":
        return dice.random() < 0.5
    if field.type.startswith("float"):
        value = dice.uniform(-_REACH, _REACH)
        return struct.unpack("f", struct.pack("f", value))[0] if field.type == "float32" else value
    if field.type in PRIMITIVES:
        bits = 8 * struct.calcsize("=" + PRIMITIVES[field.type])
        return dice.getrandbits(bits) - (1 << (bits - 1) if field.type.startswith("int") else 0)
    return arbitrary(types, field.type, dice)
