"""One short line of text for each packet, as a person would put it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import names
from edoras_tools.cfs.arguments import ARGUMENTS, command_line
from edoras_tools.links.table import links, protocol
from edoras_tools.model import OTHER, Decoded
from edoras_tools.ros.cdr.bulk import MessageColumns, Ragged
from edoras_tools.ros.cdr.plan import CdrPlan, Repeat
from edoras_tools.ros.library import PLACEHOLDER
from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import VERSION_1, MsgIds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.wire.arrays import Integers, Mask, Places

    Column: TypeAlias = "NDArray[Any] | Ragged | Group"

LAYER_TEXTS: Final = {
    cfe.EVENT.name: (("app_name", "event_id", "message"), "{} {}: {}"),
    cfe.SOFTWARE_BUS_HOUSEKEEPING.name: (
        ("pipe_overflow_error_counter", "message_limit_error_counter", "no_subscribers_counter"),
        "pipe overflow {}, message limit {}, no subscribers {}",
    ),
}
"""Layers with a text of their own: the fields, and the format."""
_MOST_FIELDS: Final = 8
_MOST_ITEMS: Final = 3


def summarise(decoded: Decoded, msg_ids: MsgIds = VERSION_1) -> Decoded:
    """Return the packet with its summary; ``msg_ids`` is the version of its MsgIds."""
    return replace(decoded, summary=_text(decoded, msg_ids))


def _text(decoded: Decoded, msg_ids: MsgIds) -> str:
    for layer in decoded.layers:
        if layer.name in LAYER_TEXTS:
            fields, form = LAYER_TEXTS[layer.name]
            values = layer.values()
            return form.format(*(values[name] for name in fields))
    if decoded.link.several:
        text = protocol(decoded.link).summary(decoded) or str(decoded.stop or "")
        if decoded.link.samples and decoded.message is not None:
            text += f": {short_values(decoded.message.values)}"
        return text
    if decoded.message is not None:
        return _message_text(decoded, decoded.message.values, msg_ids)
    packet, command = decoded.layer("ccsds"), decoded.layer("cfe_command")
    if packet is not None and (unit := _unit_of(decoded)):
        return unit.summary(decoded)
    if packet is None and decoded.link.last_hop and decoded.layers:
        return short_values(decoded.layers[-1].values())
    if packet is None:
        text = protocol(decoded.link).summary(decoded) if decoded.link is not OTHER else ""
        return text or (str(decoded.stop) if decoded.stop else f"{len(decoded.datagram.payload)} bytes")
    if command is not None and not packet.values()["packet_type"]:
        return "header only"
    standard = msg_ids.standard(packet.values()["msg_id"])
    return packet_text(standard, command.values()["function_code"] if command else None)


def _message_text(decoded: Decoded, values: Mapping[str, Any], msg_ids: MsgIds) -> str:
    """Return a message in a few words; a command of the built-in table with the names of its arguments."""
    if decoded.layer("edoras") is not None:
        return short_values(values)
    own = {name: value for name, value in values.items() if name != "header"}  # it is in the line already
    return _command_text(decoded, msg_ids) or short_values(own)


def _command_text(decoded: Decoded, msg_ids: MsgIds) -> str:
    """Return a command of the built-in table with its arguments; empty for another message."""
    packet, command, message = decoded.layer("ccsds"), decoded.layer("cfe_command"), decoded.message
    if packet is None or command is None or message is None or not message.shipped:
        return ""
    key = msg_ids.standard(packet.values()["msg_id"]), command.values()["function_code"]
    return command_line(*key, message.values) if key in ARGUMENTS else ""


def _unit_of(decoded: Decoded) -> LinkProtocol | None:
    """Return the link whose unit a packet holds; None if it holds none."""
    return next((link for link in links() if link.in_packets and decoded.layer(link.layouts[0].name)), None)


@lru_cache(maxsize=4096)
def packet_text(msg_id: int, function_code: int | None) -> str:
    """Return the text of a packet without a message.

    Args:
        msg_id: MsgId of version 1.
        function_code: function code of a command; None for telemetry.
    """
    if function_code is None:
        return names.message_name(msg_id)
    name = names.command_name(msg_id, function_code)
    return f"function code {function_code}{f' {name}' if name else ''}"


def message_texts(messages: MessageColumns, plan: CdrPlan, *, leave_out: str = " ") -> list[str]:
    """Return ``short_values`` of many messages; empty if a type has lists of messages with lists.

    Args:
        leave_out: prefix of the fields to leave out.
    """
    columns = grouped_columns(messages, plan)
    if columns is None:
        return []
    columns_shown = {
        name: column
        for name, column in columns.items()
        if not name.startswith(leave_out) and not name.endswith(PLACEHOLDER)
    }
    return _words(columns_shown, len(messages))


class Group(msgspec.Struct, frozen=True):
    """A list of messages: the columns of all elements, and the range of each row's elements.

    Attributes:
        offsets: start of each row's elements, and the end of the last ones, i64, as in ``Ragged``.
        columns: fields of all elements by dotted name.
    """

    offsets: Integers
    columns: dict[str, NDArray[Any]]


def grouped_columns(messages: MessageColumns, plan: CdrPlan) -> dict[str, Column] | None:
    """Return the columns of messages, with one for each list of messages; None for lists inside lists."""
    columns: dict[str, Column] = {}
    lists = [step for step in plan.steps if isinstance(step, Repeat) and not step.plan.single]
    if any(step.plan.lists for step in lists):
        return None
    for name, column in messages.fields.items():
        outer = next((step.name for step in lists if name.startswith(f"{step.name}.")), "")
        if outer and isinstance(column, Ragged):
            group = columns.setdefault(outer, Group(column.offsets, {}))
            assert isinstance(group, Group), "the fields of a list follow each other"
            group.columns[name.removeprefix(f"{outer}.")] = column.values
        else:
            columns[name] = column
    return columns


def _words(columns: Mapping[str, Column], count: int) -> list[str]:
    """Return ``short_values`` of ``count`` rows."""
    words: list[list[str]] = [[] for _ in range(count)]
    number = np.zeros(count, np.int64)
    for name in sorted(columns, key=lambda name: name.startswith("header.")):
        column = columns[name]
        says = _say_something(column)
        number += says
        rows = np.flatnonzero(says & (number <= _MOST_FIELDS))
        for row, text in zip(rows.tolist(), _texts(column, rows), strict=True):
            words[row].append(f"{name}={text}")
    more = (number > _MOST_FIELDS).tolist()
    return [" ".join(some) + " ..." * cut or "all zero" for some, cut in zip(words, more, strict=True)]


def _say_something(column: Column) -> Mask:
    """Return which values of a column are listed: non-zero values, and arrays that are not empty."""
    if isinstance(column, (Ragged, Group)):
        return np.diff(column.offsets) > 0
    if column.ndim > 1:
        return np.full(len(column), column.shape[1] > 0)
    return np.asarray(column != ("" if column.dtype == object else 0), np.bool_)


def _texts(column: Column, rows: Places) -> list[str]:
    if isinstance(column, (Ragged, Group)):
        start, count = column.offsets[rows], column.offsets[rows + 1] - column.offsets[rows]
        some = np.minimum(count, _MOST_ITEMS)
        ends = np.cumsum(some)
        places = np.arange(some.sum()) + np.repeat(start - ends + some, some)
        if isinstance(column, Group):
            inside = {name: values[places] for name, values in column.columns.items()}
            items = [f"{{{text}}}" for text in _words(inside, len(places))]
        else:
            items = _values(column.values[places])
        bounds = zip((ends - some).tolist(), ends.tolist(), count.tolist(), strict=True)
        return [_listed(items[first:end], size) for first, end, size in bounds]
    if column.ndim > 1:
        return [_listed(_values(some), column.shape[1]) for some in column[rows, :_MOST_ITEMS]]
    return _values(column[rows])


def _values(column: NDArray[Any]) -> list[str]:
    values = column.tolist()
    return [f"{value:.6g}" for value in values] if column.dtype.kind == "f" else list(map(str, values))


def short_values(values: Mapping[str, Any]) -> str:
    """Return a message in a few words: zeros left out, long arrays cut, the header last."""
    leaves = [leaf for leaf in leaves_of(values) if leaf[1] or leaf[1] not in (0, "", [], b"")]
    leaves.sort(key=lambda leaf: leaf[0].startswith("header."))
    words = [f"{path}={_short(value)}" for path, value in leaves[:_MOST_FIELDS]]
    return " ".join(words) + " ..." * (len(leaves) > _MOST_FIELDS) if words else "all zero"


def leaves_of(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the value of every field that is not a message itself."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves_of(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple, bytes)):
        return _listed([_short(item) for item in value[:_MOST_ITEMS]], len(value))
    if isinstance(value, dict):
        return "{" + short_values(value) + "}"
    return str(value)


def _listed(some: Sequence[str], count: int) -> str:
    return f"[{', '.join(some)}{f', ... {count}' if count > _MOST_ITEMS else ''}]"
