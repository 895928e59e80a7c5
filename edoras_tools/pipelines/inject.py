"""Messages and commands that were never recorded: made up, and sent once or at a rate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.pipelines.gates import enable_output
from edoras_tools.pipelines.orders import To
from edoras_tools.pipelines.replay import Loaded
from edoras_tools.pipelines.topics import SET, Encoder, routes_towards, sender_of
from edoras_tools.ros.arbitrary import arbitrary
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.wire import cfe
from edoras_tools.wire.names import COMMANDS, MSG_ID_NAMES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.mission import Mission, Route
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.workbench import Workbench

_MOST: Final = 1 << 17
"""Random messages that are made up before the first leaves; a longer run begins them anew."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to inject.

    Attributes:
        what: a topic, a key, a MsgId; or a command's name, as ``to-enable`` or ``noop``.
        values: what comes with it: a message as YAML or JSON, ``@FILE`` with one; or a command's argument.
        command: a MsgId and a function code, instead of ``what``.
        payload: bytes behind the command header.
        function_code: of a message that travels as a command.
        count: how often; 0 for no end.
        every_field_random: make values up, new ones each time.
        seed: for the same ones again.
    """

    what: str = ""
    values: str = ""
    command: tuple[int, int] | None = None
    payload: bytes = b""
    function_code: int = SET
    count: int = 1
    every_field_random: bool = False
    seed: int = 0


def make(order: Order, bench: Workbench, orders: Orders) -> tuple[Loaded, Orders]:
    """Make the packets of an order.

    Args:
        order: what.
        bench: its mission knows the topics, its types the messages.
        orders: where to.

    Returns:
        the packets of one pass, and the orders with the passes that make up the count.

    Raises:
        ConfigError: the values are no YAML, or a command takes no such argument.
        FieldError: a value does not fit its field; says which field, and what it takes.
        RouteError: no topic or command is called that, or it does not go there.
    """
    passes = order.count
    if order.command is not None:
        packets = [Packet(_command(*order.command, order.payload))]
    elif (named := _named(order, orders)) is not None:
        packets = [Packet(named)]
    else:
        packets = list(_messages(order, bench, orders))
        passes = passes // len(packets)
    out = Outgoing.packets(orders.to.link, packets, sender=sender_of(orders, bench.mission))
    return Loaded(out), replace(orders, passes=passes)


def receiver(order: Order, mission: Mission) -> To:
    """Return where an order goes by its route; commands, and what is not known yet, go to Command Ingest."""
    if order.command is None:
        for to in To:
            if any(order.what in names for names in _all_names(routes_towards(to, mission))):
                return to
    return To.CI


def command_names() -> list[str]:
    """Return the names that ``inject`` knows, as ``to-enable`` and ``es-noop``."""
    return ["to-enable", "noop", *(name for name, _, _ in _commands())]


def _commands() -> Iterator[tuple[str, int, int]]:
    """Yield (name, MsgId, function code) of commands that are a bare header."""
    for msg_id, codes in COMMANDS.items():
        app = MSG_ID_NAMES[msg_id].removesuffix("_CMD").lower()
        for code, command in codes.items():
            if cfe.COMMAND_HEADER_BYTES in command.lengths:
                yield f"{app}-{command.name.lower().replace('_', '-')}", msg_id, code


def _named(order: Order, orders: Orders) -> bytes | None:
    """Return the packet of a command that has a name; None where the name is none of those."""
    name = order.what.lower().replace("_", "-")
    if name == "to-enable":
        address = order.values or orders.here
        if len(address) > 15 or address.count(".") != 3:
            raise ConfigError(f"to-enable takes an IPv4 address, not {address!r}")
        return enable_output(address)
    if name == "noop":
        msg_id, code = _noop(order.values), 0
    else:
        found = next(((msg_id, code) for known, msg_id, code in _commands() if known == name), None)
        if found is None:
            return None
        msg_id, code = found
        if order.values:
            raise ConfigError(f"{name} takes nothing more, not {order.values!r}")
    return _command(msg_id, code, b"")


def _noop(text: str) -> int:
    """Return the MsgId that a no-op is for: given itself, or by the name of its app."""
    apps = {MSG_ID_NAMES[msg_id].removesuffix("_CMD").lower(): msg_id for msg_id in COMMANDS}
    wanted = text.strip().lower()
    if wanted in apps:
        return apps[wanted]
    try:
        return int(wanted, 0)
    except ValueError:
        said = f"not {text!r}" if text else "and none is named"
        raise ConfigError(f"noop takes a MsgId or an app ({', '.join(apps)}), {said}") from None


def _command(msg_id: int, function_code: int, payload: bytes) -> bytes:
    return cfe.emit_command(msg_id, function_code, payload, sequence_flags=0, with_checksum=False)


def _messages(order: Order, bench: Workbench, orders: Orders) -> Iterator[Packet]:
    route = _route(order.what, bench.mission, orders.to)
    if not bench.types.has(route.type):
        raise RouteError(f"{route.topic}: {bench.types.check(route.type)}")
    encoder = Encoder.of(route, bench, order.function_code)
    if not order.every_field_random:
        yield encoder.packet(bench.types.encode(route.type, _values(order.values)), 0)
        return
    if order.values:
        raise ConfigError("--every-field-random makes the values up; leave the message out")
    dice = Random(order.seed)  # noqa: S311  for tests, and the same each time
    wanted = order.count or _MOST
    # Whole passes over what fits, so that the count comes out right.
    count = wanted if wanted <= _MOST else next(n for n in range(_MOST, 0, -1) if wanted % n == 0)
    for _ in range(count):
        values = arbitrary(bench.types, route.type, dice)
        yield encoder.packet(bench.types.encode(route.type, values), 0)


def _route(name: str, mission: Mission, to: To) -> Route:
    """Return the route that a name means: among those that go to the receiver, if there are several."""
    towards = routes_towards(to, mission)
    try:
        route = mission.find(name)
    except RouteError as error:
        wanted = "/" + name.removeprefix("/")
        fitting = [item for item in towards if wanted == item.topic or name == item.key]
        if len(fitting) == 1:
            return fitting[0]
        if not any(name in item for item in _all_names(mission.routes)):
            raise RouteError(f"{error}; commands with a name: {', '.join(command_names()[:3])} ...") from None
        raise
    if route not in towards:
        there = ", ".join(item.topic for item in towards) or "none"
        where = next((item for item in To if route in routes_towards(item, mission)), None)
        hint = f"--to {where}" if where else "it comes from cFS"
        raise RouteError(f"{route.topic} does not go to {to}: {hint}; to {to} go {there}")
    return route


def _all_names(routes: Sequence[Route]) -> Sequence[tuple[str, ...]]:
    return [
        (item.topic, item.topic.removeprefix("/"), item.key, f"0x{item.msg_id:04x}", f"0x{item.msg_id:x}")
        for item in routes
    ]


def _values(text: str) -> dict[str, Any]:
    """Read a message from YAML, of which JSON is a part, or from ``@FILE``; nothing means all defaults."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    where = "the message"
    if text.startswith("@"):
        where = text[1:]
        try:
            text = Path(where).read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{where}: cannot be read: {getattr(error, 'strerror', None) or error}"
            ) from None
    try:
        values = YAML(typ="safe", pure=True).load(text) if text.strip() else {}
    except (YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        why = getattr(error, "problem", None) or str(error).partition("\n")[0]
        raise ConfigError(f"{where}: is no YAML:{place} {why}; write '{{linear: {{x: 0.5}}}}'") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: takes fields and values, as '{{linear: {{x: 0.5}}}}', not {values!r}")
    return values
