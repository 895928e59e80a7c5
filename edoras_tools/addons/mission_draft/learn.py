"""Learns a system from its captures: a mission file with the constants that they show, and the evidence."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.mission_draft.constants import clean_rates, joined_constants, shown_constants
from edoras_tools.addons.mission_draft.draft import MissionDraft, each_draft, read_traffic
from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination
from edoras_tools.errors import CaptureError
from edoras_tools.mission import loads
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterator, Sequence

    from edoras_tools.addons.mission_draft.constants import LearnedConstant
    from edoras_tools.addons.mission_draft.draft import CapturedTraffic, OpenInput
    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.evidence.table import Recorder
    from edoras_tools.io import Source
    from edoras_tools.model import Columns, Link, PacketBatch
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.text import Progress

_APPS: Final = {
    "": "cFE",
    "ci_": "Command Ingest",
    "app_": "the applications, and their robot",
    "robot_": "the applications, and their robot",
    "to_": "Telemetry Output",
    "sbn_": "the Software Bus Network",
}
"""Application that a constant belongs to, by the beginning of the constant's name."""
_PAUSE_NS: Final = 60 * SECOND
"""Pause between captures from which on each is learned separately: cFS may differ in each."""
_HEADER: Final = """\
# Learned from {name}.
# Each constant has its interval and what shows it; what the captures cannot show is not here. Names of topics
# are made from MsgIds: edit them. Give this file with -c; edoras sim -c emulates this system.
"""


def learn_mission(
    opened: OpenInput, settings: Settings, progress: Progress | None = None
) -> dict[str, MissionDraft]:
    """Read captures several times and return the file of each spacecraft, by the prefix of its topics.

    Args:
        opened: opens the same input anew.
        settings: missions, types, and how packets are decoded; the learned ports are added.

    Raises:
        CaptureError: the captures cannot be read, or contain nothing of cFS.
    """
    every, ports = read_traffic(opened, settings, progress)
    options = settings.options
    settings = replace(settings, options=replace(options, ports=(*options.ports, *ports)))

    return each_draft(every, lambda captured: _learned(captured, ports, *opened(settings)))


def _learned(
    captured: CapturedTraffic, ports: Sequence[tuple[Link, int]], source: Source, bench: Workbench
) -> MissionDraft:
    """Return the file of one spacecraft.

    Raises:
        CaptureError: the capture contains nothing of a cFS.
    """
    draft = MissionDraft("", 0, 0, ())
    with suppress(CaptureError):  # no EDORAS messages, but perhaps cFS
        draft = captured.draft()
    types, msg_ids = bench.types, bench.mission.msg_ids
    if draft.topics:
        files = {**bench.mission.files, "draft.yaml": draft.text.encode()}
        bench = bench.with_mission(loads(files, check_type=types.check, msg_ids=msg_ids))
    study = _Study(bench.columns.context, captured.number)
    examine(source, bench, examination=study)
    systems = study.systems()
    if not draft.topics and not systems:
        raise CaptureError(f"{captured.name}: nothing of a cFS is in it")
    if draft.topics:
        draft = captured.draft(study.rates)
    first, *others = systems.items() or [("", [])]
    bridged = {
        getattr(bridge, name)
        for link in bench.columns.context.links
        for bridge in bench.mission.links
        if bridge.kind == link.bridge
        for name in link.bridge_ports
    }
    ways = captured.traffic.ways
    own = {(link, target.port) for link, counts in ways.items() for _, target in counts}
    further = [item for item in ports if item[1] not in bridged and (item in own or item[0] not in ways)]
    keys = [*_keys(study, further, captured.traffic.orders), *_constants(first[1])]
    lines = [f"flight_software: # cFS {first[0]}".rstrip(), "  ros__parameters:", "    cfs:"] if keys else []
    lines += [*keys, *_others(others)]
    name = "".join(item if item.isprintable() else "?" for item in captured.name)
    text = draft.text.partition("-c.\n")[2] if draft.topics else ""
    text = _HEADER.format(name=name) + text + "\n".join(["", *lines, ""])
    return replace(draft, constants=len(first[1]), text=text)


class _Study(Examination):
    """An examination that learns from each chapter of a spacecraft while it is judged.

    Attributes:
        rates: the highest clean rate in Hz, by link and MsgId.
        datagrams: number of examined datagrams in chapters whose telemetry has a time.
    """

    def __init__(self, context: Context, number: int) -> None:
        super().__init__(context)
        self._number = number
        self.rates: dict[tuple[str, int], float] = {}
        self.datagrams = 0
        self._chapters: list[dict[str, list[LearnedConstant]]] = []
        self._last_ns: int | None = None

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; after a long pause it belongs to another capture, and so to another chapter."""
        if len(batch):
            if self._last_ns is not None and int(batch.time_ns[0]) > self._last_ns + _PAUSE_NS:
                self.separate()
            self._last_ns = int(batch.time_ns[-1])
        if not (own := columns.spacecraft == self._number).all():
            batch, columns = batch.take(own), columns.take(own)
        super().add(batch, columns)

    def judged(self, recorder: Recorder, chapter: Chapter) -> Diagnosis:
        """Judge a chapter, and learn from its case."""
        diagnosis = super().judged(recorder, chapter)
        case = diagnosis.case
        if case is not None and len(case.rows):
            self._chapters.append(shown_constants(case))
            for key, rate in clean_rates(case).items():
                self.rates[key] = max(rate, self.rates.get(key, 0.0))
            self.datagrams += len(case.rows) if case.instances.items else 0
        return diagnosis

    def systems(self) -> dict[str, list[LearnedConstant]]:
        """Return the constants of each cFS, by its name, the main sender to the ground first."""
        names = dict.fromkeys(name for constants in self._chapters for name in constants)
        real_names = [name for name in names if name]
        for constants in self._chapters:
            # A chapter may have no event and no peer that names its cFS, while the others name exactly one.
            if len(real_names) == 1 and real_names[0] not in constants and "" in constants:
                constants[real_names[0]] = constants.pop("")
        return {
            name: joined_constants(chapters)
            for name in names
            if (chapters := [constants[name] for constants in self._chapters if name in constants])
        }


def _keys(study: _Study, ports: Sequence[tuple[Link, int]], orders: Counter[str]) -> Iterator[str]:
    """Yield lines about the form of packets, and about ports."""
    headers, packets = study.context.headers, plural(study.datagrams, "datagram")
    if study.datagrams:  # telemetry with a time, whose lengths are known
        yield f"      extended_header: {str(headers.extended).lower()} # {headers.name}, in {packets}"
        yield f"      telemetry_header: {headers.telemetry_bytes}"
    if headers.msg_ids.version != 1:
        yield f"      msg_id_version: {headers.msg_ids.version} # as it was given"
    if str(study.context.time):
        yield f"      time: {study.context.time} # as {packets} have it"
    if orders["big"] > orders["little"]:
        yield f"      big_endian: 1 # {orders['big']} of {plural(orders.total(), 'event')}, by their types"
    if ports:
        names = ", ".join(f'"{link.label}:{port}"' for link, port in ports)
        yield f"      ports: [{names}] # lengths, types and MsgIds agree as only these links' do"


def _app(name: str) -> str:
    """Return the prefix of the names of an application's constants, from the name of one."""
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
    """Yield comments about the other cFS, because a file has only one."""
    for name, constants in systems:
        yield f"# Of cFS {name or 'of no name'}, for a file of its own:"
        yield from (f"# {line}" for line in _constants(constants))
