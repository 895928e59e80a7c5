"""The part of a capture that is held against the emulated cFS: what went in, and what both lost.

1. At most 60 s around the worst loss are judged again by themselves; what went into cFS then goes through an
   emulated one with the constants that the capture shows, or that somebody gave, at the same times. What came
   in the 15 s before goes in too: a backlog; of what came earlier the sessions of SBN and the commands to
   Telemetry Output, whose effect lasts.
2. What an application published that the emulated cFS does not have is published in it at the times that the
   capture shows.
3. When a round begins is not known: it runs twice, half a round later. How fast the host was is not known
   either, and a burst and its reader race on it: of several hosts the one counts that explains all MsgIds.
4. The model explains the capture if for each MsgId it loses as many, give or take three of a hundred that
   were sent, or three. Losses outside cFS's queues it has none of: the network, closed ports, bad commands.
5. With each advice that promises what will be left it has to lose no more than that.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Scenario, Simulation
from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.addons.lab.emulator.apps.edoras import ROBOT_HOUSEKEEPING, SingleRobotApp
from edoras_tools.addons.lab.emulator.routes import DEMO_ROUTES
from edoras_tools.addons.lab.emulator.services.software_bus import HOP
from edoras_tools.cfs import edoras_app
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.cfs.telemetry_output import COMMAND_MSG_ID as TO_COMMAND
from edoras_tools.diagnosis.advice import Arrivals, published_at, told_limit
from edoras_tools.diagnosis.ledger import PEER_RESTARTED, UNHEARD
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.links.table import among
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.cfe import STANDARD, WITH_EXTENDED, WITH_EXTENDED_2, emit_telemetry
from edoras_tools.wire.msg_id import VERSION_1, VERSION_2

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis

    Published = Mapping[int, NDArray[np.int64]]

WINDOW_NS: Final = 60 * SECOND
BEFORE_NS: Final = 15 * SECOND
_BOOTED_NS: Final = 3 * SECOND
_DRAINS_NS: Final = 15 * SECOND
_ROOM: Final = 3
_SHARE: Final = 0.03
_POSE_BYTES: Final = 60
"""Of the CDR of an arm's command; a rover's Twist has 52."""
_STATE_BYTES: Final = 100
"""Longer states are an arm's joints."""
_NETWORK: Final = {"after", "network", "port_closed", "unreachable", "fragments", "damaged", "proxy"}
_OUTSIDE: Final = {*_NETWORK, "bad_command", UNHEARD, PEER_RESTARTED}
"""Causes of losses outside cFS's queues."""
_PIPES: Final = ("EDORAS", "CI_", "TO_", "SBN", "SCH_", "ES_", "EVS_", "SB_", "TBL_", "TIME_")
"""How the pipes of applications begin that the emulated cFS has."""
_FROM_ELSEWHERE: Final = "SOMEBODY"
_PASSED_NOTHING: Final = f"{edoras_app.NAME} was started again and passed nothing on"


class Host(NamedTuple):
    """How fast a host is, as far as a burst and its reader race on it: constants of ``SimProfile``.

    Attributes:
        ci_read_ns: how long Command Ingest takes for a datagram.
        latency_ns: shortest and longest time until a task runs that may run.
        obey_work_ns: how long the application takes for a command.
    """

    ci_read_ns: int
    latency_ns: tuple[int, int]
    obey_work_ns: int


_USUAL: Final = SimProfile()
_MEASURED: Final = [Host(11_000, (17_000, 43_000), obey_ns) for obey_ns in (75_000, 40_000, 15_000)]
"""On a real cFS on two busy cores, between the system calls of its tasks: Command Ingest took 6 to 40 us for
each of 1,475 datagrams, the median 11; its application ran after 17 to 43 us, took 50 to 135 for the first
command of a burst, the median 75, and 10 to 70 for the others."""
_ASSUMED: Final = [Host(read_ns, _USUAL.latency_ns, _USUAL.obey_work_ns) for read_ns in (3_000, 12_000)]
"""These fit captures of slower hosts."""
HOSTS: Final = {**dict.fromkeys(_ASSUMED, "assumed"), **dict.fromkeys(_MEASURED, "measured")}
"""From slow to fast, each with where its constants are from."""


class Stimulus(NamedTuple):
    """A datagram that went into cFS.

    Attributes:
        time_ns: when.
        over_network: over SBN, not to Command Ingest.
        msg_id: of its packet; -1 where it has none.
        payload: its bytes.
    """

    time_ns: int
    over_network: bool
    msg_id: int
    payload: bytes


class ModelInput(NamedTuple):
    """What an emulated cFS gets.

    Attributes:
        stimuli: what goes in.
        profile: its constants.
        published: MsgId to when it is published, ns, in place of what its applications publish of it.
    """

    stimuli: Sequence[Stimulus]
    profile: SimProfile
    published: Published


class ModelRun(msgspec.Struct, frozen=True):
    """What the emulated cFS did.

    Attributes:
        lost_ns: MsgId and place to when it lost each message there.
        entered: MsgId and place to the messages that came to it.
    """

    lost_ns: dict[tuple[int, str], list[int]]
    entered: Counter[tuple[int, str]]

    def lost(self, msg_id: int, place: str = "") -> int:
        """Return how many of a MsgId it lost, at one place or at all."""
        every = self.lost_ns.items()
        return sum(len(times) for key, times in every if key == (msg_id, place or key[1]))


class ProofRow(NamedTuple):
    """One MsgId, in the capture and in the model.

    Attributes:
        msg_id: the MsgId.
        name: how people are told of it.
        sent: messages in the capture.
        lost: at least and at most lost in the capture.
        model: at least and at most lost by the model, over its runs.
        outside: lost in the capture outside cFS's queues, of which the model has none.
    """

    msg_id: int
    name: str
    sent: int
    lost: tuple[int, int]
    model: tuple[int, int]
    outside: int = 0

    @property
    def distance(self) -> int:
        """How many more or fewer the model loses than it may to explain the capture; 0 where it does."""
        room = max(_ROOM, round(_SHARE * self.sent))
        return max(0, self.model[0] - room - self.lost[1], self.lost[0] - self.model[1] - room)

    @property
    def explained(self) -> bool:
        """Whether the model loses as many."""
        return not self.distance

    def joined(self, other: ProofRow) -> ProofRow:
        """Return one row of two MsgIds that are one message: what went in, and as what it came out."""
        both = zip((self.lost, self.model), (other.lost, other.model), strict=True)
        lost, model = ((one[0] + two[0], one[1] + two[1]) for one, two in both)
        name, outside = f"{self.name} and {other.name}", self.outside + other.outside
        return self._replace(name=name, lost=lost, model=model, outside=outside)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --prove --json``."""
        return {**self._asdict(), "msg_id": f"0x{self.msg_id:04x}", "explained": self.explained}


class AdviceProof(NamedTuple):
    """What the model loses where an advice is followed.

    Attributes:
        msg_id: of which MsgId, as text.
        name: how people are told of it.
        advice: in words.
        promised: messages that the doctor said would be left.
        left: at least and at most lost.
        run: the first run, for the picture.
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
        """Return it in the shape of ``doctor --prove --json``."""
        values = {name: value for name, value in self._asdict().items() if name != "run"}
        return {**values, "kept": self.keeps_promise}


class CaptureProof(msgspec.Struct, frozen=True):
    """What the model says of a capture.

    Attributes:
        span: seconds into the capture that were judged.
        rows: the MsgIds that lost any.
        not_modelled: why nothing was emulated; empty where it was.
        advices: those that promise what will be left and that the model can try, of the worst loss first.
        hosts: it explains most between these, a slower and a faster one.
        run: the first run, for the picture.
        lost_ns: place to when messages were lost there, in the capture.
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
        """Whether the model explains what was lost."""
        return not self.not_modelled and all(row.explained for row in self.rows)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --prove --json``."""
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
    """Return from when to when a capture is judged: ns since 1970."""
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
        case: what the capture shows.
        start_ns: from when on what it loses is counted.
        end_ns: until when.
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
        """Let it run on a host twice, half a round later."""
        return [self.run(phase, host, inputs) for phase in (0, 1)]

    def run(self, phase: int, host: Host, inputs: ModelInput) -> ModelRun:
        """Let datagrams go in once.

        Args:
            phase: half rounds by which it begins later.
            host: how fast its host is.
            inputs: what it gets.
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
            # Of telemetry in a pipe that is closed, or that nobody asks for, what is followed is lost.
            if item.end in LOST and (item.end is not QueueEnd.CLOSED or msg_id in followed):
                lost.setdefault((msg_id, place + " was full" * (item.end in full)), []).append(item.end_ns)
        if isinstance(edoras, SingleRobotApp) and not edoras.has_robot:
            useless = [time_ns for time_ns in read[edoras.robot_commands :] if time_ns >= start_ns]
            lost[edoras.command, _PASSED_NOTHING] = useless
        return ModelRun(lost, at_pipes)


def prove(result: Diagnosis, case: Case, stimuli: Sequence[Stimulus], span: tuple[int, int]) -> CaptureProof:
    """Hold the judged part of a capture against the emulated cFS.

    Args:
        result: the diagnosis of that part.
        case: what it was judged by.
        stimuli: what went into cFS then, and shortly before.
        span: from when to when, ns since 1970.
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
    """Return what cFS gets, with what its applications published that the emulated ones do not."""
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
        if stream.link.only_from_cfs and told_limit(case, stream) is None:
            limits.setdefault(stream.msg_id, inputs.profile.to_default_limit)
    return inputs._replace(published=published, profile=replace(inputs.profile, to_limits=limits))


def _range(runs: Sequence[ModelRun], msg_id: int, place: str = "") -> tuple[int, int]:
    """Return how many were lost at least and at most; telemetry that nobody asked for may be none of them."""
    unasked = [0 if VERSION_1.is_command(msg_id) else run.lost(msg_id, HOP) for run in runs]
    most = [run.lost(msg_id, place) for run in runs]
    return min(max(0, one - two) for one, two in zip(most, unasked, strict=True)), max(most)


def _not_modelled(case: Case) -> str:
    """Return what the emulated cFS has no application for; empty where it has all."""
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
        if row.msg_id is None:  # may be of any
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
    for hop in case.hops:  # a message may be told to be lost as what went in, or as what was to come out
        into, out = rows.get(hop.into.msg_id), rows.get(hop.out.msg_id)
        if into and out and into is not out and not (into.explained and out.explained):
            joined = into.joined(out)
            if joined.explained:
                rows[into.msg_id] = joined
                del rows[out.msg_id]
    return list(rows.values())


def _lost_times(case: Case) -> dict[str, list[int]]:
    """Return where and when messages were lost; several evenly from the first to the last."""
    times: dict[str, list[int]] = {}
    for entry in case.ledger.losses():
        place = entry.text.removeprefix("over the message limit of ")
        times.setdefault(place, []).extend(np.linspace(*entry.times_ns, entry.number).astype(int).tolist())
    return times


def _advices(
    result: Diagnosis, case: Case, model: Model, host: Host, inputs: ModelInput
) -> Iterator[AdviceProof]:
    """Yield what becomes of each advice that promises what will be left, of the worst loss first."""
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
    """Yield what an advice says and the model can try, in words, each with what cFS gets then."""
    stimuli, profile, published = inputs
    # At most so many Hz, or so many in so many ms: each as early as that lets it.
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
