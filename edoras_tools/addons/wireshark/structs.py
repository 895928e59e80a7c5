"""Structs of own layouts and of cFE's housekeeping, as tables from which the dissector adds headers."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.structs.shapes import BasicKind
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.structs import Structs
    from edoras_tools.structs.bound import Bound
    from edoras_tools.structs.transcode import StructLeaf

_MOST: Final = 512
"""Most values of a struct that are shown."""
_IN_THE_ENGINE: Final = (cfe.EVENT_MSG_ID, cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID)
_WHOLE: Final = {BasicKind.UINT: "uint", BasicKind.BOOL: "uint", BasicKind.CHAR: "uint", BasicKind.INT: "int"}


def engine_structs(structs: Structs) -> dict[str, Any]:
    """Return the structs that a layout names, and those of cFE's telemetry, for ``engine/packet.lua``.

    Commands, events and the software bus's counters have tables in the engine, unless a layout names them.

    Returns:
        ``layouts``: a table for each struct in a packet, by name; ``packets``: by MsgId the ``name`` of the
        packets, if all have the same and it is not one of cFE's, and the name of the table by function code
        (-1: all codes).
    """
    layouts: dict[str, Any] = {}
    packets: dict[int, dict[Any, Any]] = {}
    for bound in structs.all:
        code, standard = bound.key.function_code, structs.msg_ids.standard(bound.key.msg_id)
        if bound.shipped and (code is not None or standard in _IN_THE_ENGINE):
            continue
        if bound.key.port is not None or bound.layout.entries:
            continue
        name = f"struct {bound.key}"
        layouts[name] = _layout(bound)
        title = "" if bound.shipped else structs.name(bound.key.msg_id)
        packet = packets.setdefault(bound.key.msg_id, {"name": title or None})
        packet[-1 if code is None else code] = name
    return {"layouts": layouts, "packets": packets}


def _layout(bound: Bound) -> dict[str, Any]:
    least, most, step = bound.extent
    leaves = bound.plan(least).leaves
    fields = [*islice((item for leaf in leaves for item in _fields(bound, leaf)), _MOST)]
    return {
        "name": bound.name,
        "protocol": "cfe",
        "title": bound.name,
        "size": least,
        "most": most,
        "step": step or None,
        "own": not bound.shipped or None,
        "little": bound.layout.byte_order == "little" or None,
        "fields": fields,
    }


def _fields(bound: Bound, leaf: StructLeaf) -> Iterator[dict[str, Any]]:
    """Yield the fields of a value, or of each element of an array; elements share the field of their name."""
    member = leaf.member
    basic, size = bound.layout.basic(member), leaf.end - leaf.start
    if basic is None or not size:
        return
    step = bound.layout.size(member) if member.array else size
    name = ".".join(part for part in leaf.path if isinstance(part, str))
    kind, mask, values = "bytes", None, bound.values(member)
    if member.text:
        kind = "string"
    elif basic.kind is BasicKind.FLOAT:
        kind = "double" if step == 8 else "float"
    elif basic.kind in _WHOLE and step in {1, 2, 4, 8}:
        kind = f"{_WHOLE[basic.kind]}{8 * step}"
        if member.bits:
            shift = member.bit if bound.layout.is_little(member) else 8 * step - member.bit - member.bits
            mask = ((1 << member.bits) - 1) << shift
        if basic.kind is BasicKind.BOOL:
            values = {0: "false", 1: "true"}
    else:
        step = size
    unit = f"in {member.unit}" if member.unit else ""
    sent = "the number as it is sent, not calibrated" if member.polynomial else unit
    for start in range(leaf.start, leaf.end, step):
        yield {
            "abbreviation": f"cfs.{bound.name}.{name}",
            "name": name,
            "start": start,
            "size": step,
            "kind": kind,
            "turned": (bool(member.order) and member.order != bound.layout.byte_order) or None,
            "mask": mask,
            "hex": (member.base == 16 and "int" in kind) or None,
            "names": dict(values) if "int" in kind and values else None,
            "doc": ", ".join(filter(None, (member.doc, sent))),
        }
