"""One short line for each packet: what a person would say of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import names
from edoras_tools.links.table import protocol
from edoras_tools.model import OTHER

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from edoras_tools.model import Decoded

_MOST_FIELDS: Final = 8
_MOST_ITEMS: Final = 3


def summarise(decoded: Decoded) -> Decoded:
    """Return the value with its summary."""
    return replace(decoded, summary=_text(decoded))


def _text(decoded: Decoded) -> str:
    event = decoded.layer("cfe_event")
    if event is not None:
        values = event.values()
        return f"{values['app_name']} {values['event_id']}: {values['message']}"
    bus = decoded.layer("cfe_software_bus")
    if bus is not None:
        values = bus.values()
        return (
            f"pipe overflow {values['pipe_overflow_error_counter']}, "
            f"message limit {values['message_limit_error_counter']}, "
            f"no subscribers {values['no_subscribers_counter']}"
        )
    if decoded.message is not None:
        bare = decoded.layer("edoras") is None  # the header of a C struct is already in the line
        return short_values({k: v for k, v in decoded.message.values.items() if not bare or k != "header"})
    if decoded.link is not OTHER and (text := protocol(decoded.link).summary(decoded)):
        return text
    return _packet(decoded)


def _packet(decoded: Decoded) -> str:
    packet, command = decoded.layer("ccsds"), decoded.layer("cfe_command")
    if packet is None:
        return str(decoded.stop) if decoded.stop else f"{len(decoded.datagram.payload)} bytes"
    msg_id = packet.values()["msg_id"]
    if command is not None and packet.values()["packet_type"]:
        code = command.values()["function_code"]
        name = names.command_name(msg_id, code)
        return f"function code {code}{f' {name}' if name else ''}"
    if command is not None:
        return "header only"
    return names.message_name(msg_id)


def short_values(values: Mapping[str, Any]) -> str:
    """Return a message in a few words: zeros left out, long arrays cut, the header last."""
    leaves = sorted(_leaves(values), key=lambda leaf: leaf[0].startswith("header."))
    words = [f"{path}={_short(value)}" for path, value in leaves if _says_something(value)]
    shown = words[:_MOST_FIELDS]
    return " ".join(shown) + (" ..." if len(words) > len(shown) else "") if words else "all zero"


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _says_something(value: Any) -> bool:
    return value not in (0, "", [], b"") or value is True


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        some = ", ".join(_short(item) for item in value[:_MOST_ITEMS])
        return f"[{some}{f', ... {len(value)}' if len(value) > _MOST_ITEMS else ''}]"
    if isinstance(value, dict):
        return "{" + short_values(value) + "}"
    return str(value)
