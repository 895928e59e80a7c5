"""Compares a part of a capture with the emulated cFS: the same input, and the losses of both.

Rules:

1. At most 60 s around the worst loss are judged again by themselves. The datagrams that went into cFS then go
   into an emulated one at the same times. Its constants are those that the capture shows, or that were given.
   To fill the queues, the datagrams of the 15 s before go in too; of earlier ones only SBN's sessions and
   commands to Telemetry Output, whose effect lasts.
2. Telemetry of applications that the emulated cFS does not have is published in it at the captured times.
3. The phase of the rounds is unknown: the model runs twice, half a round apart. The speed of the host is
   unknown too, and decides the race of a burst and its reader: the host that explains most is used.
4. The model explains the capture if its losses of each MsgId differ by at most 3 % of the sent messages, or
   by at most three messages. It has no losses outside cFS's queues, as in the network, at closed ports, or of
   bad commands.
5. With an advice that promises a number of remaining losses, the model must lose at most that number.

The capture is read twice: it is judged, then the part around its worst loss, and the model runs on that part.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Scenario, Simulation
from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.addons.lab.emulator.apps.core import ROBOT_HOUSEKEEPING, SingleRobotApp
from edoras_tools.addons.lab.emulator.cfs import DEMO_ROUTES
from edoras_tools.addons.lab.emulator.services.software_bus import HOP
from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.cfs.telemetry_output import COMMAND_MSG_ID as TO_COMMAND
from edoras_tools.diagnosis.advice import Arrivals, published_at
from edoras_tools.diagnosis.ledger import PEER_RESTARTED, UNHEARD
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.links.table import among
from edoras_tools.model import Peer
from edoras_tools.pipelines.doctor import Scope, examine
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.selection import Period
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.ccsds import VERSION_1, VERSION_2
from edoras_tools.wire.cfe import STANDARD, WITH_EXTENDED, WITH_EXTENDED_2, emit_telemetry

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench

    Published = Mapping[int, NDArray[np.int64]]
    OpenInput = Callable[[], tuple[Source, Workbench]]

WINDOW_NS: Final = 60 * SECOND
BEFORE_NS: Final = 15 * SECOND
_BOOTED_NS: Final = 3 * SECOND
_DRAINS_NS: Final = 15 * SECOND
_ROOM: Final = 3
_SHARE: Final = 0.03
_POSE_BYTES: Final = 60
"""Size of the CDR of an arm's command, bytes; a rover's Twist has 52."""
_STATE_BYTES: Final = 100
"""Size from which a state has an arm's joints, bytes."""
_NETWORK: Final = {"after", "network", "port_closed", "unreachable", "fragments", "damaged", "proxy"}
_OUTSIDE: Final = {*_NETWORK, "bad_command", UNHEARD, PEER_RESTARTED}
"""Causes of losses outside cFS's queues."""
_PIPES: Final = ("EDORAS", "CI_", "TO_", "SBN", "SCH_", "ES_", "EVS_", "SB_", "TBL_", "TIME_")
"""Prefixes of the pipes of applications that the emulated cFS has."""
_FROM_ELSEWHERE: Final = "SOMEBODY"
_PASSED_NOTHING: Final = f"{edoras_app.NAME} was started again and passed nothing on"


class Host(NamedTuple):
    """Speed of a host, as far as the race of a burst and its reader needs it: constants of ``SimProfile``.

    Attributes:
        ci_read_ns: time of Command Ingest for one datagram, ns.
        latency_ns: shortest and longest time from "may run" to "runs" of a task, ns.
        obey_work_ns: time of the application for one command, ns.
    """

    ci_read_ns: int
    latency_ns: tuple[int, int]
    obey_work_ns: int


_USUAL: Final = SimProfile()
_MEASURED: Final = [Host(11_000, (17_000, 43_000), obey_ns) for obey_ns in (75_000, 40_000, 15_000)]
"""Measured on a real cFS on two busy cores, between the system calls of its tasks. Command Ingest took 6 to
40 us for each of 1,475 datagrams, the median was 11. Its application ran after 17 to 43 us; it took 50 to
135 us for the first command of a burst, the median was 75, and 10 to 70 us for the others."""
_ASSUMED: Final = [Host(read_ns, _USUAL.latency_ns, _USUAL.obey_work_ns) for read_ns in (3_000, 12_000)]
"""Hosts that fit captures of slower computers."""
HOSTS: Final = {**dict.fromkeys(_ASSUMED, "assumed"), **dict.fromkeys(_MEASURED, "measured")}
"""Hosts from slow to fast, each with the origin of its constants."""


class Stimulus(NamedTuple):
    """A datagram that went into cFS.

    Attributes:
        time_ns: time, ns since 1970.
        over_network: whether it went to SBN, not to Command Ingest.
        msg_id: MsgId of its packet; -1 if it has none.
        payload: payload.
    """

    time_ns: int
    over_network: bool
    msg_id: int
    payload: bytes


class ModelInput(NamedTuple):
    """The input of an emulated cFS.

    Attributes:
        stimuli: datagrams.
        profile: constants.
        published: MsgId to the times when it is published, ns; the emulated applications do not publish it.
    """

    stimuli: Sequence[Stimulus]
    profile: SimProfile
    published: Published


class ModelRun(msgspec.Struct, frozen=True):
    """The result of one run of the emulated cFS.

    Attributes:
        lost_ns: MsgId and place to the time of each loss, ns.
        entered: MsgId and place to the number of messages that arrived there.
    """

    lost_ns: dict[tuple[int, str], list[int]]
    entered: Counter[tuple[int, str]]

    def lost(self, msg_id: int, place: str = "") -> int:
        """Return the number of lost messages of a MsgId, at one place or in all."""
        every = self.lost_ns.items()
        return sum(len(times) for key, times in every if key == (msg_id, place or key[1]))


class ProofRow(NamedTuple):
    """One MsgId, in the capture and in the model.

    Attributes:
        msg_id: the MsgId.
        name: name for people.
        sent: messages in the capture.
        lost: least and most losses in the capture.
        model: least and most losses of the model, over its runs.
        outside: losses in the capture outside cFS's queues, which the model does not have.
    """

    msg_id: int
    name: str
    sent: int
    lost: tuple[int, int]
    model: tuple[int, int]
    outside: int = 0

    @property
    def distance(self) -> int:
        """Distance of the model's losses from those that explain the capture; 0 if they do."""
        room = max(_ROOM, round(_SHARE * self.sent))
        return max(0, self.model[0] - room - self.lost[1], self.lost[0] - self.model[1] - room)

    @property
    def explained(self) -> bool:
        """Whether the model's losses explain those of the capture."""
        return not self.distance

    def joined(self, other: ProofRow) -> ProofRow:
        """Return one row for two MsgIds of the same message: into cFS, and out of it."""
        both = zip((self.lost, self.model), (other.lost, other.model), strict=True)
        lost, model = ((one[0] + two[0], one[1] + two[1]) for one, two in both)
        name, outside = f"{self.name} and {other.name}", self.outside + other.outside
        return self._replace(name=name, lost=lost, model=model, outside=outside)

    def as_json(self) -> dict[str, Any]:
        """Return the row in the shape of ``doctor --prove --json``."""
        return {**self._asdict(), "msg_id": f"0x{self.msg_id:04x}", "explained": self.explained}


class AdviceProof(NamedTuple):
    """The losses of the model if an advice is followed.

    Attributes:
        msg_id: MsgId, as text.
        name: name for people.
        advice: text of the advice.
        promised: remaining losses that the doctor promised.
        left: least and most losses.
        run: first run, for the picture.
    """

    msg_id: str
    name: str
    advice: str
    promised: int
    left: tuple[int, int]
    run: ModelRun

    @property
    def keeps_promise(self) -> bool:
        """Whether the advice keeps what the doctor promised."""
        return self.left[0] <= self.promised + _ROOM

    def as_json(self) -> dict[str, Any]:
        """Return the proof in the shape of ``doctor --prove --json``."""
        values = {name: value for name, value in self._asdict().items() if name != "run"}
        return {**values, "kept": self.keeps_promise}


class CaptureProof(msgspec.Struct, frozen=True):
    """The comparison of a capture with the model.

    Attributes:
        span: judged part, seconds from the capture's zero.
        rows: MsgIds that lost messages.
        not_modelled: reason why nothing was emulated; empty if it was.
        advices: advices that promise a number and that the model can try; that of the worst loss first.
        hosts: slower and faster host whose runs together explain most.
        run: first run, for the picture.
        lost_ns: place to the times of the losses there in the capture, ns.
    """

    span: tuple[float, float]
    rows: Sequence[ProofRow] = ()
    not_modelled: str = ""
    advices: Sequence[AdviceProof] = ()
    hosts: tuple[Host, Host] = (_ASSUMED[0], _ASSUMED[1])
    run: ModelRun = msgspec.field(default_factory=lambda: ModelRun({}, Counter()))
    lost_ns: Mapping[str, Sequence[int]] = msgspec.field(default_factory=dict)

    @property
    def explained(self) -> bool:
        """Whether the model explains the losses."""
        return not self.not_modelled and all(row.explained for row in self.rows)

    def as_json(self) -> dict[str, Any]:
        """Return the proof in the shape of ``doctor --prove --json``."""
        advices = [item.as_json() for item in self.advices]
        first = advices[0] if advices else {}
        return {
            "start_s": round(self.span[0], 3),
            "end_s": round(self.span[1], 3),
            "explained": None if self.not_modelled else self.explained,
            "not_modelled": self.not_modelled or None,
            "hosts": [item._asdict() for item in self.hosts],
            "hosts_from": HOSTS.get(self.hosts[0], "given"),
            **{name: first.get(name) for name in ("advice", "promised", "left", "kept")},
            "advices": advices,
            "routes": [row.as_json() for row in self.rows],
        }


def window(diagnosis: Diagnosis) -> tuple[int, int]:
    """Return the begin and the end of the judged part, ns since 1970."""
    if diagnosis.end_ns - diagnosis.start_ns <= WINDOW_NS:
        return diagnosis.start_ns, diagnosis.end_ns
    losses = [item for item in diagnosis.verdicts if item.lost]
    worst = max(losses, key=lambda item: item.lost or 0, default=None)
    middle = (worst.start_ns + worst.end_ns) // 2 if worst else diagnosis.start_ns
    start = min(max(middle - WINDOW_NS // 2, diagnosis.start_ns), diagnosis.end_ns - WINDOW_NS)
    return start, start + WINDOW_NS


class Model:
    """The emulated cFS of a capture.

    Args:
        case: case of the judged part.
        start_ns: time from which losses are counted, ns since 1970.
        end_ns: time until which losses are counted, ns since 1970.
    """

    def __init__(self, case: Case, start_ns: int, end_ns: int) -> None:
        self._span = start_ns, end_ns
        self._followed = {*DEMO_ROUTES["two-rovers"].flight, *(hop.out.msg_id for hop in case.hops)}
        rows = case.rows
        to_ci = among(rows.link, lambda link: link.only_to_cfs)
        long = rows.header_length[to_ci] == WITH_EXTENDED.command_bytes
        headers = WITH_EXTENDED if 2 * int(long.sum()) > len(long) else STANDARD
        headers = WITH_EXTENDED_2 if case.mission.msg_ids is VERSION_2 else headers
        own = case.instances.items[0].name if case.instances.items else "66:1"
        peer = Peer(*map(int, own.split(":"))) if own else Peer(66, 1)
        inbound = [item for item in case.streams if item.link.peers and not item.counted]
        identities = {case.network.identity_of.get(stream.sender, ""): stream for stream in inbound}
        peers = tuple(
            SbnPeerConfig(Peer(*map(int, name.split(":"))), case.endpoints[stream.sender].port)
            for name, stream in identities.items()
            if name and name != own
        )
        self.profile: SimProfile = replace(
            case.profile,
            spacecraft_id=peer.spacecraft_id,
            processor_id=peer.processor_id,
            sbn_peers=peers or case.profile.sbn_peers,
            headers=headers,
        )
        lengths = {stream.msg_id: int(np.median(rows.cdr_length[stream.rows])) for stream in case.streams}
        two = bool(peers)
        arm = lengths.get(DEMO_ROUTES["arm"].commands[0]) == _POSE_BYTES or (
            two
            and max((lengths.get(item, 0) for item in DEMO_ROUTES["two-arms"].states), default=0)
            > _STATE_BYTES
        )
        name = f"two-{'arms' if arm else 'rovers'}" if two else "arm" if arm else "rover"
        self.scenario = cast("Scenario", name)

    def runs(self, host: Host, inputs: ModelInput) -> list[ModelRun]:
        """Run the model on a host twice, half a round apart."""
        return [self.run(phase, host, inputs) for phase in (0, 1)]

    def run(self, phase: int, host: Host, inputs: ModelInput) -> ModelRun:
        """Run the model once.

        Args:
            phase: number of half rounds by which it starts later.
            host: speed of its host.
            inputs: datagrams and constants.
        """
        stimuli, profile, published = inputs
        first = min([item.time_ns for item in stimuli[:1]] + [self._span[0]])
        begin_ns = first - _BOOTED_NS + phase * profile.ci_wake_ns // 2
        own = replace(profile, seed=profile.seed + phase, **host._asdict())
        simulation = Simulation(own, self.scenario, start_ns=begin_ns, bridges=False, with_account=True)
        cfs = simulation.cfs
        for item in stimuli:
            endpoint = cfs.sbn_endpoint if item.over_network else cfs.ci_endpoint
            simulation.feed(item.time_ns, endpoint, item.payload)
        cfs.muted = frozenset(published)
        for msg_id, times in published.items():
            for time_ns in times.tolist():
                simulation.inject(time_ns, emit_telemetry(msg_id), _FROM_ELSEWHERE)
        end_ns = max(self._span[1], stimuli[-1].time_ns if stimuli else 0) + _DRAINS_NS
        for _ in simulation.run(end_ns):
            pass
        return self._count(simulation, stimuli, end_ns)

    def _count(self, simulation: Simulation, stimuli: Sequence[Stimulus], end_ns: int) -> ModelRun:
        start_ns, stop_ns = self._span[0], end_ns - _DRAINS_NS
        cfs, edoras = simulation.cfs, simulation.apps.edoras
        sockets = {socket(cfs.profile.ci_port): "CI's socket", socket(cfs.profile.sbn_port): "SBN's socket"}
        full = {QueueEnd.PIPE_OVERFLOW, QueueEnd.SOCKET_FULL}
        sent = {(item.time_ns, item.over_network): item.msg_id for item in stimuli}
        followed = {*sent.values(), *self._followed}
        at_pipes: Counter[tuple[int, str]] = Counter()
        lost: dict[tuple[int, str], list[int]] = {}
        read: list[int] = []
        for item in cfs.account.arrivals:
            if isinstance(edoras, SingleRobotApp) and item.msg_id == edoras.command:
                read += [item.end_ns] * (item.end is QueueEnd.DELIVERED)
            if not start_ns <= item.begin_ns <= stop_ns + SECOND:
                continue
            place, msg_id = sockets.get(item.hop, item.hop), item.msg_id
            if item.hop in sockets:
                msg_id = sent.get((item.begin_ns, place[0] == "S"), -1)
            elif item.hop != HOP:
                at_pipes[msg_id, place] += item.begin_ns <= stop_ns
            # In a closed pipe only messages with a followed MsgId count as lost.
            if item.end in LOST and (item.end is not QueueEnd.CLOSED or msg_id in followed):
                lost.setdefault((msg_id, place + " was full" * (item.end in full)), []).append(item.end_ns)
        if isinstance(edoras, SingleRobotApp) and not edoras.has_robot:
            useless = [time_ns for time_ns in read[edoras.robot_commands :] if time_ns >= start_ns]
            lost[edoras.command, _PASSED_NOTHING] = useless
        return ModelRun(lost, at_pipes)


def prove(result: Diagnosis, case: Case, stimuli: Sequence[Stimulus], span: tuple[int, int]) -> CaptureProof:
    """Compare the judged part of a capture with the emulated cFS.

    Args:
        result: diagnosis of that part.
        case: case of that part.
        stimuli: datagrams that went into cFS then, and shortly before.
        span: begin and end, ns since 1970.
    """
    seconds = (span[0] - result.zero_ns) / SECOND, (span[1] - result.zero_ns) / SECOND
    if why := _not_modelled(case):
        return CaptureProof(seconds, not_modelled=why)
    model = Model(case, *span)
    hosts = list(HOSTS)
    if model.profile.ci_read_ns != _USUAL.ci_read_ns:
        hosts = [hosts[0]._replace(ci_read_ns=model.profile.ci_read_ns)] * 2
    inputs = _with_others(case, model, ModelInput(stimuli, model.profile, {}))
    runs, proofs = [model.runs(hosts[0], inputs)], list[CaptureProof]()
    for pair in pairwise(hosts):
        runs.append(model.runs(pair[1], inputs))
        rows = _rows(result, case, runs[-2] + runs[-1])
        proofs.append(CaptureProof(seconds, rows, hosts=pair, run=runs[-2][0]))
        if proofs[-1].explained:
            break
    proof = min(proofs, key=lambda item: sum(row.distance for row in item.rows))
    advices = list(_advices(result, case, model, proof.hosts[0], inputs))
    return replace(proof, advices=advices, lost_ns=_lost_times(case))


def _with_others(case: Case, model: Model, inputs: ModelInput) -> ModelInput:
    """Return the input with the telemetry that the emulated applications do not publish themselves."""
    probe = model.run(0, _ASSUMED[0], inputs)
    published: dict[int, NDArray[np.int64]] = {}
    limits = dict(inputs.profile.to_limits)
    for stream in case.streams:
        is_core = stream.known_id in MSG_ID_NAMES or stream.known_id == ROBOT_HOUSEKEEPING
        if is_core or not (stream.counted and stream.link.from_cfs):
            continue
        times = published_at(case, stream)
        entered = max((number for key, number in probe.entered.items() if key[0] == stream.msg_id), default=0)
        if 2 * entered > len(times):
            continue
        published[stream.msg_id] = max(times, published.get(stream.msg_id, times), key=len)
        if stream.link.only_from_cfs and case.commanded_limit(stream) is None:
            limits.setdefault(stream.msg_id, inputs.profile.to_default_limit)
    return inputs._replace(published=published, profile=replace(inputs.profile, to_limits=limits))


def _range(runs: Sequence[ModelRun], msg_id: int, place: str = "") -> tuple[int, int]:
    """Return the least and the most losses; telemetry without a subscriber counts in the most only."""
    unasked = [0 if VERSION_1.is_command(msg_id) else run.lost(msg_id, HOP) for run in runs]
    most = [run.lost(msg_id, place) for run in runs]
    return min(max(0, one - two) for one, two in zip(most, unasked, strict=True)), max(most)


def _not_modelled(case: Case) -> str:
    """Return the reason why the emulated cFS cannot replace the captured one; empty if it can."""
    names = {item.name for item in case.instances.items}
    if len(names) > 1:
        return f"the capture has {len(names)} cFS, {' and '.join(sorted(names))}, and one is emulated"
    emulated = {
        *MSG_ID_NAMES,
        *(own for demo in DEMO_ROUTES.values() for own in (*demo.commands, *demo.states)),
    }
    emulated.add(case.profile.generator_msg_id)
    into = [hop.into for hop in case.hops if hop.into.link.to_cfs and hop.into.is_command]
    if others := sorted(stream.msg_id for stream in into if stream.known_id not in emulated):
        return f"0x{others[0]:04x} goes to an application that is not EDORAS's"
    pipes = sorted({item.pipe for item in case.reported_losses if not item.pipe.startswith(_PIPES)} - {""})
    return f"{pipes[0]} is of an application that is not EDORAS's" if pipes else ""


def _rows(result: Diagnosis, case: Case, runs: Sequence[ModelRun]) -> list[ProofRow]:
    numbers: dict[int, tuple[int, int, int, int]] = {}
    unknown = 0
    for row in result.balance:
        if row.msg_id is None:  # it may belong to any MsgId
            unknown += row.all_lost + row.unaccounted + row.uncertain
            continue
        outside = sum(number for cause, number in row.lost.items() if cause in _OUTSIDE)
        came, lost, more, away = numbers.get(row.msg_id, (0, 0, 0, 0))
        more += row.uncertain + row.shared
        numbers[row.msg_id] = max(came, row.came), lost + row.proven - outside, more, away + outside
    rows = {}
    for msg_id, (sent, lost, more, outside) in sorted(numbers.items()):
        model = _range(runs, msg_id)
        if lost or model[1] or outside:
            most = lost + more + unknown
            rows[msg_id] = ProofRow(msg_id, case.name(msg_id), sent, (lost, most), model, outside)
    for hop in case.hops:  # a loss may be counted for the message into cFS, or for the one out of it
        into, out = rows.get(hop.into.msg_id), rows.get(hop.out.msg_id)
        if into and out and into is not out and not (into.explained and out.explained):
            joined = into.joined(out)
            if joined.explained:
                rows[into.msg_id] = joined
                del rows[out.msg_id]
    return list(rows.values())


def _lost_times(case: Case) -> dict[str, list[int]]:
    """Return the times of the losses by place; those of one entry are spread evenly over its span."""
    times: dict[str, list[int]] = {}
    for entry in case.ledger.losses():
        place = entry.text.removeprefix("over the message limit of ")
        times.setdefault(place, []).extend(np.linspace(*entry.times_ns, entry.number).astype(int).tolist())
    return times


def _advices(
    result: Diagnosis, case: Case, model: Model, host: Host, inputs: ModelInput
) -> Iterator[AdviceProof]:
    """Yield the result of each advice that promises a number, that of the worst loss first."""
    tried: set[tuple[int, str]] = set()
    for problem in summarize(result).problems:
        msg_id = problem.verdicts[0].msg_id if problem.verdicts else None
        if msg_id is None or problem.left is None:
            continue
        for remedy, trial in _trials(case, problem.remedy, msg_id, inputs):
            if (msg_id, remedy) not in tried:
                tried.add((msg_id, remedy))
                runs = model.runs(host, trial)
                is_input = any(item.msg_id == msg_id for item in inputs.stimuli)
                remains = _range(runs, msg_id, "" if is_input else problem.verdicts[0].hop or "")
                yield AdviceProof(
                    f"0x{msg_id:04x}", case.name(msg_id), remedy, problem.left, remains, runs[0]
                )


def _trials(case: Case, text: str, msg_id: int, inputs: ModelInput) -> Iterator[tuple[str, ModelInput]]:
    """Yield the parts of an advice that the model can try, as text, each with the changed input."""
    stimuli, profile, published = inputs
    # Spread the messages: each as early as the advised rate permits.
    if slower := re.search(r"(?:send |publish )?at most ([\d.]+) (?:Hz|in (\d+) ms)", text):
        gap_ns = (int(slower[2]) * MILLISECOND if slower[2] else SECOND) / float(slower[1])
        own = [item for item in stimuli if item.msg_id == msg_id]
        every = [published_at(case, item) for item in case.streams if item.msg_id == msg_id and item.counted]
        times = np.array([item.time_ns for item in own]) if own else max(every, key=len)
        even = Arrivals(times, np.full(len(times), msg_id)).spaced(gap_ns, msg_id).time_ns
        if own:
            others = [item for item in stimuli if item.msg_id != msg_id]
            others += [item._replace(time_ns=when) for item, when in zip(own, even.tolist(), strict=True)]
            yield slower[0], inputs._replace(stimuli=sorted(others, key=lambda item: item.time_ns))
        else:
            yield slower[0], inputs._replace(published={**published, msg_id: even})
    if raised := re.search(r"raise TO's limit for it to (\d+)", text):
        limits, entry = {**profile.to_limits, msg_id: int(raised[1])}, msg_id.to_bytes(4, "little")
        others = [item for item in stimuli if item.msg_id != TO_COMMAND or entry not in item.payload]
        yield raised[0], ModelInput(others, replace(profile, to_limits=limits), published)
    if higher := re.search(r"let the application subscribe with a limit of (\d+)", text):
        yield higher[0], inputs._replace(profile=replace(profile, app_msg_limit=int(higher[1])))


def prove_capture(opened: OpenInput) -> tuple[Diagnosis, CaptureProof]:
    """Judge a capture and prove it; return the diagnosis of the whole capture, and the proof.

    Args:
        opened: function that opens the same input again.

    Raises:
        CaptureError: the capture cannot be read.
    """
    source, bench = opened()
    whole = examine(source, bench)
    if whole.failure is not None:
        raise whole.failure
    every = whole.diagnosis
    span = window(every)
    part = every
    if span != (every.start_ns, every.end_ns):
        start_ns = span[0] - every.zero_ns
        period = Period(start_ns=start_ns, end_ns=start_ns + span[1] - span[0])
        source, bench = opened()
        part = examine(source, bench, scope=Scope(period=period)).diagnosis
    case = part.case
    if case is None or not part.datagrams:
        return every, CaptureProof((0.0, 0.0), not_modelled="nothing of cFS was examined")
    if part is not every:
        part = replace(part, capture=replace(part.capture, zero_ns=every.zero_ns))
    return every, prove(part, case, _stimuli(opened, case, span), span)


def _stimuli(opened: OpenInput, case: Case, span: tuple[int, int]) -> list[Stimulus]:
    """Return datagrams into cFS: from ``BEFORE_NS`` before a span to its end, and earlier ones that last."""
    source, bench = opened()
    stimuli: list[Stimulus] = []
    lasting: dict[bytes, Stimulus] = {}
    begin_ns = span[0] - BEFORE_NS
    inbound = [item for item in case.streams if item.link.peers and not item.counted]
    ports = [case.endpoints[item.receiver].port for item in inbound]
    streams = [item.rows for item in case.streams if item.link.only_to_cfs]
    commands = case.rows.number[np.concatenate([np.zeros(0, np.intp), *streams])]
    with reading(source, bench) as loop:
        for rows in loop:
            batch, columns = rows.batch, rows.columns
            to_ci = among(columns.link, lambda link: link.only_to_cfs)
            over = among(columns.link, lambda link: link.peers) & np.isin(batch.destination_port, ports)
            is_early = batch.time_ns < begin_ns
            lasts = (columns.msg_id == telemetry_output.COMMAND_MSG_ID) | (over & (columns.msg_id < 0))
            # Datagrams captured twice, or in front of a relay, are in no stream.
            judged = over | (batch.time_ns < span[0]) | np.isin(batch.number, commands)
            inside = (lasts | ~is_early) & judged & (batch.time_ns <= span[1])
            for row in np.flatnonzero((to_ci | over) & inside).tolist():
                when, msg_id = max(int(batch.time_ns[row]), begin_ns), int(columns.msg_id[row])
                item = Stimulus(when, bool(over[row]), msg_id, bytes(batch[row].payload))
                if is_early[row]:
                    lasting.pop(item.payload, None)  # keep the last of equal ones, at its place
                    lasting[item.payload] = item
                else:
                    stimuli.append(item)
    return [*lasting.values(), *sorted(stimuli, key=lambda item: item.time_ns)]
