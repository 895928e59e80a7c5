"""Learns a system from its captures: a mission file with what they show of its cFS, and by what."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.mission_draft.constants import clean_rates, shown_constants
from edoras_tools.addons.mission_draft.draft import MissionDraft, read_traffic
from edoras_tools.errors import CaptureError
from edoras_tools.mission import loads
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterator, Sequence

    from edoras_tools.addons.mission_draft.constants import LearnedConstant
    from edoras_tools.addons.mission_draft.draft import OpenInput
    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.model import Link
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.render.terminal.text import Progress

_APPS: Final = {
    "": "cFE",
    "ci_": "Command Ingest",
    "app_": "the applications, and their robot",
    "robot_": "the applications, and their robot",
    "to_": "Telemetry Output",
    "sbn_": "the Software Bus Network",
}
"""Whose constants they are, by how their names begin."""
_HEADER: Final = """\
# Learned from {name}.
# Each constant has its interval and what shows it; what the captures cannot show is not here. Names of topics
# are made from MsgIds: edit them. Give this file with -c; edoras sim -c emulates this system.
"""


def learn_mission(opened: OpenInput, settings: Settings, progress: Progress | None = None) -> MissionDraft:
    """Read captures several times and return the file of their system.

    Args:
        opened: opens the same input anew.
        settings: missions, types, and how packets are decoded; what is learned is added.

    Raises:
        CaptureError: they cannot be read, or hold nothing of cFS.
    """
    captured, ports = read_traffic(opened, settings, progress)
    options = settings.options
    settings = replace(settings, options=replace(options, ports=(*options.ports, *ports)))
    draft = MissionDraft("", 0, 0, ())
    with suppress(CaptureError):  # nothing of EDORAS, but perhaps cFS
        draft = captured.draft()
    source, bench = opened(settings)
    types, msg_ids = bench.types, bench.mission.msg_ids
    if draft.topics:
        files = {**bench.mission.files, "draft.yaml": draft.text.encode()}
        bench = bench.with_mission(loads(files, check_type=types.check, msg_ids=msg_ids))
    case = examine(source, bench).diagnosis.case
    systems = shown_constants(case) if case is not None and len(case.rows) else {}
    if not draft.topics and not systems:
        raise CaptureError(f"{captured.name}: nothing of a cFS is in it")
    if draft.topics and case is not None:
        draft = captured.draft(clean_rates(case))
    first, *others = systems.items() or [("", [])]
    bridged = {
        getattr(bridge, name)
        for link in bench.columns.context.links
        for bridge in bench.mission.links
        if bridge.kind == link.bridge
        for name in link.bridge_ports
    }
    further = [item for item in ports if item[1] not in bridged]
    keys = [*_keys(bench.columns.context, further, captured.traffic.orders, case), *_constants(first[1])]
    lines = [f"flight_software: # cFS {first[0]}".rstrip(), "  ros__parameters:", "    cfs:"] if keys else []
    lines += [*keys, *_others(others)]
    name = "".join(item if item.isprintable() else "?" for item in captured.name)
    text = draft.text.partition("-c.\n")[2] if draft.topics else ""
    return replace(
        draft, constants=len(first[1]), text=_HEADER.format(name=name) + text + "\n".join(["", *lines, ""])
    )


def _keys(
    context: Context, ports: Sequence[tuple[Link, int]], orders: Counter[str], case: Case | None
) -> Iterator[str]:
    """Yield the lines about how packets are built and which ports they have."""
    headers = context.headers
    if case is not None and case.instances.items:  # telemetry with a time, whose lengths are known
        packets = plural(len(case.rows), "datagram")
        yield f"      extended_header: {str(headers.extended).lower()} # {headers.name}, in {packets}"
        yield f"      telemetry_header: {headers.telemetry_bytes}"
    if headers.msg_ids.version != 1:
        yield f"      msg_id_version: {headers.msg_ids.version} # as it was given"
    if orders["big"] > orders["little"]:
        yield f"      big_endian: 1 # {orders['big']} of {plural(orders.total(), 'event')}, by their types"
    if ports:
        names = ", ".join(f'"{link.label}:{port}"' for link, port in ports)
        yield f"      ports: [{names}] # lengths, types and MsgIds agree as only these links' do"


def _app(name: str) -> str:
    """Return how the names of an application's constants begin."""
    return next((begin for begin in _APPS if begin and name.startswith(begin)), "")


def _constants(constants: Sequence[LearnedConstant]) -> Iterator[str]:
    """Yield a line for each constant, below a comment with its application."""
    app = ""
    for item in sorted(constants, key=lambda item: [*_APPS].index(_app(item.name))):
        own = _APPS[_app(item.name)]
        if own != app:
            yield f"      # {own}"
            app = own
        if item.msg_id is None:
            yield f"      {item.name}: {item.value} # {item.evidence}"
    limits = [item for item in constants if item.msg_id is not None]
    if limits:
        yield "      # Telemetry Output's table: how many of a MsgId may wait"
        yield "      to_limits:"
    for item in limits:
        yield f"        0x{item.msg_id:04X}: {item.value} # {item.evidence}"


def _others(systems: Sequence[tuple[str, Sequence[LearnedConstant]]]) -> Iterator[str]:
    """Yield comments about the other cFS: a file has one."""
    for name, constants in systems:
        yield f"# Of cFS {name or 'of no name'}, for a file of its own:"
        yield from (f"# {line}" for line in _constants(constants))
