"""The Lua dissector for a mission: the knowledge that the layouts do not contain, as plain values.

Without a mission it knows the four demos of the EDORAS paper. If two of them use the same MsgId, the first
whose message type fits the bytes is used. Structs of own layouts and of cFE's housekeeping become tables,
from which the dissector adds headers.
"""

from __future__ import annotations

import ipaddress
from importlib.resources import files
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.decode import Context
from edoras_tools.dissectors.lua import FindingText, Knowledge, RouteText, generate
from edoras_tools.mission import Mission, load, loads
from edoras_tools.model import NO_ROUTE, UNKNOWABLE, Finding
from edoras_tools.render.severity import EXPLANATIONS, Level
from edoras_tools.ros import TypeStore
from edoras_tools.ros.cdr.plan import CdrPlan, PrimitiveRun, Repeat, Text
from edoras_tools.ros.library import PLACEHOLDER, full_name
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.structs.files import load_layout
from edoras_tools.structs.shapes import BasicKind
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.structs.bindings import Bound
    from edoras_tools.structs.messages import StructLeaf


DEMOS: Final = (
    ("rover_ground",),
    ("single_arm_ground",),
    ("two_rovers_ground", "two_rovers_flight"),
    ("two_arms_ground", "two_arms_flight"),
)


def dissector(settings: Settings) -> tuple[str, list[str]]:
    """Return the Lua dissector for the missions, or for the demos if there is none; and warnings.

    Raises:
        ConfigError: a mission file, a type folder or an option has errors. An unknown type is only a warning:
            the rest of its packets is still dissected.
    """
    types = TypeStore(settings.distro, settings.msg_paths)
    if settings.configs:
        missions = [load(settings.configs, msg_ids=settings.options.msg_ids)]
        note = f"Routes of {', '.join(missions[0].files)}; ROS 2 {settings.distro}."
    else:
        missions = [_demo(names) for names in DEMOS]
        note = f"Routes of the demos of the EDORAS paper; ROS 2 {settings.distro}."
    warnings = [text for mission in missions for text in mission.warnings]
    for name in dict.fromkeys(route.type for mission in missions for route in mission.routes):
        why = types.check(name)
        if why is not None:
            warnings.append(f"{name} is left as bytes: {why}")
    layouts = [load_layout(path) for path in settings.structs]
    msg_ids, software = settings.options.msg_ids, missions[0].software
    shipped = shipped_structs(msg_ids, big_endian=software.big_endian)
    structs = Structs([*layouts, *shipped.layouts], msg_ids) if layouts else None
    contexts = [
        Context(mission, types, settings.options.saying(mission.software.headers), structs)
        for mission in missions
    ]
    return generate(replace(_knowledge(contexts, types), note=note)), warnings


def _demo(names: Sequence[str]) -> Mission:
    folder = files("edoras_tools.samples") / "missions"
    return loads({f"{name}.yaml": (folder / f"{name}.yaml").read_bytes() for name in names})


def _ports(masks: Iterable[NDArray[np.bool_]]) -> list[int]:
    return sorted({int(port) for mask in masks for port in np.flatnonzero(mask)})


def _knowledge(contexts: Sequence[Context], types: TypeStore) -> Knowledge:
    """Collect the knowledge of several missions; routes are numbered in their order."""
    routes: list[RouteText] = []
    exact: dict[str, dict[int, list[int]]] = {link.label: {} for link in contexts[0].links}
    any_link: dict[int, list[int]] = {}
    for context in contexts:
        first = len(routes)
        routes += [
            RouteText(route.topic, full_name(route.type), context.envelopes[index])
            for index, route in enumerate(context.mission.routes)
        ]
        for link in contexts[0].links:
            _claim(exact[link.label], context.routes_on(link), first)
        _claim(any_link, context.any_route_of, first)
    headers, table = contexts[0].headers, contexts[0].structs.dictionary
    return Knowledge(
        findings=[_finding(item) for item in Finding],
        links=contexts[0].links,
        ports={link.label: _ports(item.ports[link] for item in contexts) for link in contexts[0].links},
        stream_ports={
            link.label: _ports(item.stream_links == link for item in contexts) for link in contexts[0].links
        },
        bridge_ports=_ports(item.bridge_ports for item in contexts),
        cfs_addresses=sorted(
            {str(ipaddress.IPv4Address(address)) for item in contexts for address in item.cfs_addresses}
        ),
        identities=sorted({identity for item in contexts for identity in item.identities}),
        routes=routes,
        exact={link: claims for link, claims in exact.items() if claims},
        any_link=any_link,
        types={
            name: _type(types, name)
            for name in dict.fromkeys(route.type for route in routes)
            if types.has(name)
        },
        extended_header=headers.extended,
        telemetry_header=headers.telemetry_bytes,
        msg_id_version=headers.msg_ids.version,
        time=contexts[0].time,
        pdu_msg_ids=sorted({int(item) for context in contexts for item in context.pdu_msg_ids}),
        frames={
            item.port: (item.format, item.link.label)
            for context in contexts
            for item in context.mission.frames
        },
        dictionary=table.engine_values() if table else {},
        structs=engine_structs(contexts[0].structs),
    )


def _claim(claims: dict[int, list[int]], route_of: Iterable[int], first: int) -> None:
    table = np.asarray(route_of)
    for msg_id in np.flatnonzero(table != NO_ROUTE).tolist():
        claims.setdefault(msg_id, []).append(first + int(table[msg_id]))


def _finding(item: Finding) -> FindingText:
    explanation = EXPLANATIONS[item]
    return FindingText(
        bit=int(item),
        label=item.label,
        severity=explanation.severity.label,
        short=explanation.short if explanation.severity > Level.NOTE else "",
        meaning=explanation.meaning,
        unknowable=item in UNKNOWABLE,
    )


def _type(types: TypeStore, name: str) -> Mapping[str, Any]:
    _, plan = types.plan(name)
    return {"fixed": plan.fixed_size, "trailing": plan.most_trailing, "steps": _steps(plan)}


def _steps(plan: CdrPlan) -> list[dict[str, Any]]:
    return [_step(step) for step in plan.steps]


def _step(step: PrimitiveRun | Text | Repeat) -> dict[str, Any]:
    if isinstance(step, PrimitiveRun):
        return {
            "alignment": step.alignment,
            "size": step.size,
            "leaves": [
                {name: getattr(leaf, name) for name in ("name", "code", "size", "count", "offset")}
                | {"hidden": leaf.name.endswith(PLACEHOLDER) or None}
                for leaf in step.leaves
            ],
        }
    if isinstance(step, Text):
        return {"name": step.name, "bound": step.bound, "width": step.width}
    uniform, first = step.plan.uniform, step.plan.steps[0]
    label = first.leaves[0].name if isinstance(first, PrimitiveRun) else first.name
    return {
        "name": step.name,
        "count": step.count,
        "bound": step.bound,
        "least": step.plan.least,
        "element": step.plan.element is not None or None,
        "uniform": {"alignment": uniform.alignment, "size": uniform.size} if uniform else None,
        "unnamed": not label or None,
        "steps": _steps(step.plan),
    }


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
