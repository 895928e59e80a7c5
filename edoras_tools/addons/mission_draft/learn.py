"""Learns a system from its captures: a mission file with the constants that they show, and the evidence.

The constants of one cFS that a capture shows have their interval and their evidence. The doctor uses fewer of
them, and only where its own values differ from the usual ones. Rules:

1. A round is a time between bursts of one sender; nearly all other times between bursts are multiples of it.
   For an output, bursts must also contain messages that waited.
2. The limit of a pipe for one MsgId shows in the rounds behind which messages are missing; a command that
   sets the limit is better evidence.
3. A constant without evidence is left out. Nothing is assumed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.mission_draft.draft import MissionDraft, each_draft, read_traffic
from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.accounting.pipes import measured_depth
from edoras_tools.diagnosis.constants import find_round
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination
from edoras_tools.diagnosis.matching.streams import Stream, bursts, full_rounds
from edoras_tools.errors import CaptureError
from edoras_tools.mission import loads
from edoras_tools.pipelines.doctor import examine
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.addons.mission_draft.draft import CapturedTraffic, OpenInput
    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case
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


_NEAR: Final = 0.15
_LEAST: Final = 3
"""Least number of rounds that show a limit."""
_OFTEN: Final = 0.25
"""Least share of these rounds that have to show the same value."""
_MOSTLY: Final = 0.4
_SOME: Final = 0.1
"""Least share of bursts with several messages; ``_MOSTLY`` is that of steps of one round between bursts."""
_RANGE: Final = 0.05, 0.95
_ALIKE: Final = 0.1
"""Largest relative difference between values of chapters that show the same constant."""


class Interval(NamedTuple):
    """The values that many rounds show.

    Attributes:
        usual: the most frequent or the median value.
        low: least value of nearly all rounds.
        high: largest value of nearly all rounds.
        rounds: number of rounds that show it.
        of: number of rounds that could show it.
    """

    usual: float
    low: float
    high: float
    rounds: int
    of: int


class LearnedConstant(NamedTuple):
    """A constant that a capture shows.

    Attributes:
        name: name of the field in ``SimProfile``.
        value: value of the constant.
        form: text of the evidence, with the names of an interval's values in braces.
        interval: values that many rounds show; None if the evidence does not come from rounds.
        msg_id: MsgId of a limit at Telemetry Output.
    """

    name: str
    value: int
    form: str
    interval: Interval | None = None
    msg_id: int | None = None

    @property
    def evidence(self) -> str:
        """The interval, and the evidence for it."""
        return self.form.format(**self.interval._asdict()) if self.interval else self.form


def joined_constants(chapters: Sequence[Sequence[LearnedConstant]]) -> list[LearnedConstant]:
    """Return the constants of one cFS that several chapters show: values that agree become one interval.

    If the values differ, somebody changed the constant, and the last value is returned.
    """
    by_name = by_key(chain.from_iterable(chapters), lambda item: (item.name, item.msg_id))
    return [_joined(items) for items in by_name.values()]


def _joined(items: Sequence[LearnedConstant]) -> LearnedConstant:
    last = items[-1]
    alike = [item for item in items if abs(item.value - last.value) <= _ALIKE * abs(last.value)]
    parts = [item.interval for item in alike if item.interval]
    if len(items) > 1 and parts:
        most = max(parts, key=lambda part: part.rounds)
        best = next(item for item in alike if item.interval is most)
        _, lows, highs, rounds, of = zip(*parts, strict=True)
        interval = Interval(most.usual, min(lows), max(highs), sum(rounds), sum(of))
        last = best._replace(interval=interval)
    others = dict.fromkeys(item.value for item in items if item not in alike)
    note = f", in {len(alike)} chapters" if len(alike) > 1 else ""
    note += f"; others show {listed([str(value) for value in others])}" if others else ""
    return last._replace(form=last.form + note)


class _Round(NamedTuple):
    """A round, in ns: the usual time, and the interval of nearly all rounds."""

    period_ns: int
    low_ns: int
    high_ns: int
    rounds: int

    @property
    def value(self) -> int:
        """The round in ns, a whole number of ms: the time of the work beside the wait is not part of it."""
        return round(self.period_ns / MILLISECOND) * MILLISECOND

    def constant(self, name: str, text: str) -> LearnedConstant:
        """Return this round as a constant; ``text`` says what these are the rounds of."""
        usual, low, high = (item / MILLISECOND for item in (self.period_ns, self.low_ns, self.high_ns))
        form = f"{{usual:.2f}} ms ({{low:.2f}} to {{high:.2f}}): {{rounds}} rounds {text}"
        return LearnedConstant(name, self.value, form, Interval(usual, low, high, self.rounds, self.rounds))


def shown_constants(case: Case) -> dict[str, list[LearnedConstant]]:
    """Return the constants that a capture shows, by name of the cFS, the main sender to the ground first."""
    sent = Counter[int]()
    for stream in case.streams:
        owner = case.owner(stream)
        if owner != NOBODY:
            sent[owner] += len(stream) * (1 + stream.link.only_from_cfs * len(case.rows))
    names = {case.instances.items[owner].name: owner for owner, _ in reversed(sent.most_common())}
    return {name: [*_Learner(case, owner).constants()] for name, owner in reversed(names.items())}


def clean_rates(case: Case) -> dict[tuple[str, int], float]:
    """Return the highest rate in Hz without a loss for ten seconds, by link and MsgId."""
    rates: dict[tuple[str, int], float] = {}
    for stream in case.streams:
        fate = case.commands.fates.get(stream)
        shows = fate.seen if fate is not None else stream.counted
        if shows and (rate := case.lossless_hz(stream, 0.0)):
            key = stream.link.label, stream.msg_id
            rates[key] = max(rate, rates.get(key, 0.0))
    return rates


class _Learner:
    """Finds the constants of one cFS that a case shows."""

    def __init__(self, case: Case, instance: int) -> None:
        self._case, self._own = case, instance
        self._system = case.instances.systems[instance]
        self._hops = [
            hop
            for hop in case.hops
            if hop.into.link.only_to_cfs and hop.out.link.last_hop and case.goes_to(hop.into, instance)
        ]

    def constants(self) -> Iterator[LearnedConstant]:
        """Yield the constants, application by application."""
        case, own = self._case, self._case.instances.items[self._own]
        spacecraft, _, processor = own.name.partition(":")
        if processor:
            for name, value in (("spacecraft_id", spacecraft), ("processor_id", processor)):
                yield LearnedConstant(name, int(value), f"{own.name} in its events, or on SBN")
        yield from self._ports({item.kind for item in case.mission.links})
        yield from self._housekeeping()
        # The doctor requires that no message waits longer than a round; in a full socket all do.
        is_full = any(loss.cause == "socket" for item in case.ingests for loss in item.losses)
        if self._hops and (is_full or "ci_wake_ns" in case.constants.rounds):
            yield from self._ingest(is_full=is_full)
        out = [item for item in case.streams if self._is_own(item)]
        yield from self._output([item for item in out if item.link.only_from_cfs])
        yield from self._network([item for item in out if item.link.peers and not item.is_command])

    def _is_own(self, stream: Stream) -> bool:
        owner = self._case.owner(stream)
        return owner != NOBODY and self._case.instances.systems[owner] == self._system

    def _times(self, stream: Stream) -> NDArray[np.int64]:
        return self._case.rows.time_ns[stream.rows]

    def _ports(self, bridges: Container[str]) -> Iterator[LearnedConstant]:
        """Yield the ports that no bridge of the mission names."""
        case = self._case
        into = [item for item in case.streams if case.goes_to(item, self._own)]
        out = [item for item in case.streams if self._is_own(item)]
        for name, kind, ends in (
            ("ci_port", "ground", [item.receiver for item in into if item.link.only_to_cfs]),
            ("to_port", "ground", [item.receiver for item in out if item.link.only_from_cfs]),
            ("sbn_port", "flight", [item.sender for item in out if item.link.peers]),
            ("robot_port", "robot", [hop.out.receiver for hop in self._hops]),
        ):
            ports = {case.endpoints[item].port for item in ends}
            if len(ports) == 1 and kind not in bridges:
                text = f"{plural(len(ends), 'stream')}, none at another port"
                yield LearnedConstant(name, ports.pop(), text)

    def _housekeeping(self) -> Iterator[LearnedConstant]:
        for stream in self._case.streams:
            if stream.known_id == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID and self._is_own(stream):
                if pace := _round(self._case.instances.made_ns[stream.rows]):
                    yield pace.constant("housekeeping_ns", "of 0x803")
                return

    def _ingest(self, *, is_full: bool) -> Iterator[LearnedConstant]:
        case = self._case
        times = [case.rows.time_ns[hop.out.rows[hop.out_rows]] for hop in self._hops]
        pace = _round(np.sort(np.concatenate(times)))
        if pace is None:
            return
        yield pace.constant("ci_wake_ns", "in which commands came to the robot")
        counts, when = case.payloads.ingest["packets"], case.payloads.ingest["time_ns"]
        steps = np.diff(counts)[np.abs(np.diff(when) - SECOND) < _NEAR * SECOND]
        usual, again = Counter(steps[steps > 0].tolist()).most_common(1)[0] if steps.any() else (0, 0)
        reads, rest = divmod(usual * pace.value, SECOND)
        if is_full and again >= _OFTEN * len(steps) and not rest:
            text = f"{usual} read in a second from a full socket, by 0x884: {plural(again, 'time')}"
            yield LearnedConstant("ci_datagrams_per_wake", reads, text)
        yield from self._application(pace.value)

    def _application(self, period_ns: int) -> Iterator[LearnedConstant]:
        case = self._case
        for hop in self._hops:
            times = case.rows.time_ns[hop.out.rows[hop.out_rows]]
            missing = np.maximum(np.append(np.diff(hop.in_rows) - 1, 0), 0)
            is_limited = any(loss.kind == "limit" for loss in case.losses_of(hop.into))
            is_limited = is_limited or bool(full_rounds(times, missing, period_ns))
            if is_limited and (limit := _round_limit(times, missing, period_ns // 4)):
                yield _limit("app_msg_limit", limit, f" of 0x{hop.into.msg_id:04x}")
                return

    def _output(self, streams: list[Stream]) -> Iterator[LearnedConstant]:
        case, name = self._case, telemetry_output.NAME
        if not streams:
            return
        every = np.isin(case.rows.source, [item.sender for item in streams])
        every &= case.rows.link == streams[0].link
        times = case.rows.time_ns[every]
        pace = _round(times, waiting=True)
        if pace is None:
            return
        yield pace.constant("to_wake_ns", f"of {name}")
        losses = [loss for item in streams for loss in case.losses_of(item)]
        if any(_at_pipe(loss, "overflow", telemetry_output.PIPE) for loss in losses):
            depth = measured_depth(times, pace.value)
            if depth < len(times):
                _, sizes = bursts(times, pace.value // 2)
                same = int((sizes == depth).sum())
                text = f"none of {plural(len(sizes), 'round')} had more, {same} so many"
                yield LearnedConstant("to_pipe_depth", depth, text)
        limits = {item.msg_id: item for stream in streams for item in self._limit(stream, pace.value)}
        yield from limits.values()

    def _limit(self, stream: Stream, period_ns: int) -> Iterator[LearnedConstant]:
        """Yield the limit of messages of a MsgId at Telemetry Output."""
        case = self._case
        command = case.commanded_limit(stream)
        known_id = case.context.msg_ids.of_known(stream.known_id)
        if command:
            text = "the last command that adds it says so"
            yield LearnedConstant("to_limits", command, text, msg_id=known_id)
            return
        lost = Counter[str]()
        for loss in case.losses_of(stream):
            lost[loss.kind] += loss.lost * loss.hop.startswith(telemetry_output.PIPE)
        times = self._times(stream)
        if lost["limit"] > lost["overflow"] and (
            limit := _round_limit(times, stream.missing, period_ns // 4)
        ):
            yield _limit("to_limits", limit, msg_id=known_id)

    def _network(self, streams: list[Stream]) -> Iterator[LearnedConstant]:
        case = self._case
        for receiver in dict.fromkeys(item.receiver for item in streams):
            own = [item for item in streams if item.receiver == receiver]
            times = np.sort(np.concatenate([self._times(item) for item in own]))
            pace = _round(times, waiting=True)
            if pace is None:
                continue
            yield pace.constant("sbn_wake_ns", f"to {case.endpoints[receiver]}")
            for stream in own:
                lost = any(_at_pipe(loss, "limit", "SBN") for loss in case.losses_of(stream))
                limit = _round_limit(self._times(stream), stream.missing, pace.value // 4) if lost else None
                if limit is not None:
                    yield _limit("sbn_msg_limit", limit, f" of 0x{stream.msg_id:04x}")
                    return
            return


def _at_pipe(loss: Loss, kind: str, pipe: str) -> bool:
    return loss.kind == kind and loss.hop.startswith(pipe)


def _round(times: NDArray[np.int64], *, waiting: bool = False) -> _Round | None:
    """Return the round in which bursts come; None if there is none.

    Args:
        times: ns, in order.
        waiting: whether bursts must show messages that waited for a round: even times of messages that are
            only published or forwarded are not the round of their sender.
    """
    period = find_round(times)
    if period is None:
        return None
    begins, sizes = bursts(times, min(20 * MILLISECOND, period // 4))
    steps = np.diff(times[begins])
    own = steps[np.abs(steps - period) < _NEAR * period]
    if waiting and (len(own) < _MOSTLY * len(steps) or (sizes > 1).sum() < _SOME * len(sizes)):
        return None
    low, high = np.quantile(own, _RANGE)
    return _Round(int(np.median(own)), int(low), int(high), len(own))


def _limit(name: str, interval: Interval, text: str = "", msg_id: int | None = None) -> LearnedConstant:
    form = "{low} to {high}: {rounds} of {of} rounds behind which some are missing" + text
    return LearnedConstant(name, int(interval.usual), form, interval, msg_id)


def _round_limit(times: NDArray[np.int64], missing: NDArray[Any], pause_ns: int) -> Interval | None:
    """Return the size of rounds behind which messages are missing; None if these rounds differ.

    A round that is read while messages arrive may have one more, so the low end counts, if it is frequent.
    """
    begins, sizes = bursts(times, pause_ns)
    full = sizes[np.flatnonzero(np.add.reduceat(missing, begins))]
    if len(full) < _LEAST:
        return None
    low, high = (int(item) for item in np.quantile(full, _RANGE, method="nearest"))
    same = int((full == low).sum())
    return Interval(low, low, high, same, len(full)) if same >= _OFTEN * len(full) else None
