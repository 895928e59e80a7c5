"""The part of a capture that is held against the emulated cFS: what went in, and what both lost.

1. At most 60 s around the worst loss are judged again by themselves; what went into cFS then goes through an
   emulated one with the constants that the capture shows, or that somebody gave, at the same times. What came
   in the 15 s before goes in too: subscriptions, commands to Telemetry Output, a backlog.
2. When a round begins is not known, nor how fast the host was, on which a burst and its reader race. So it
   runs several times: half a round later, and with a CI that takes 3 and 12 us for a datagram.
3. The model explains the capture if for each MsgId it loses as many, give or take three of a hundred that
   were sent, or three. Losses outside cFS it has none of: the network, closed ports.
4. With the advice of the worst loss it has to lose no more than the doctor promised.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.lab.emulator import Scenario, Simulation
from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.addons.lab.emulator.apps.edoras import SingleRobotApp, TwoRobotApp
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.cfs.profile import SbnPeerConfig
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.links.table import among
from edoras_tools.model import Peer
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND
from edoras_tools.wire.cfe import WITH_EXTENDED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.verdict import Verdict

WINDOW_NS: Final = 60 * SECOND
BEFORE_NS: Final = 15 * SECOND
_BOOTED_NS: Final = 3 * SECOND
_DRAINS_NS: Final = 15 * SECOND
_RUNS: Final = tuple((phase, read_ns) for phase in (0, 1) for read_ns in (3 * MICROSECOND, 12 * MICROSECOND))
"""Half rounds by which it begins later, and how long CI takes for a datagram: a slower host loses less."""
_ROOM: Final = 3
_SHARE: Final = 0.03
_POSE_BYTES: Final = 60
"""Of the CDR of an arm's command; a rover's Twist has 52."""
_STATE_BYTES: Final = 100
"""Longer states are an arm's joints."""
_OUTSIDE: Final = frozenset({"after", "network", "port_closed", "unreachable", "fragments", "proxy"})
"""Causes of losses outside cFS."""
_PIPES: Final = ("EDORAS", "CI_", "TO_", "SBN", "SCH_", "ES_", "EVS_", "SB_", "TBL_", "TIME_")
"""How the pipes of applications begin that the emulated cFS has."""


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


@dataclass(frozen=True, slots=True)
class ModelRun:
    """What the emulated cFS did.

    Attributes:
        lost: MsgId to the messages that it lost.
        arrived_ns: MsgId to when its messages were read at their last pipe.
    """

    lost: Counter[int]
    arrived_ns: dict[int, list[int]]


@dataclass(frozen=True, slots=True)
class ProofRow:
    """One MsgId, in the capture and in the model.

    Attributes:
        msg_id: the MsgId.
        name: how people are told of it.
        sent: messages in the capture.
        lost: at least and at most lost in the capture.
        model: at least and at most lost by the model, over its runs.
        outside: lost in the capture outside cFS, of which the model has none.
    """

    msg_id: int
    name: str
    sent: int
    lost: tuple[int, int]
    model: tuple[int, int]
    outside: int = 0

    @property
    def explained(self) -> bool:
        """Whether the model loses as many."""
        room = max(_ROOM, round(_SHARE * self.sent))
        return self.model[0] - room <= self.lost[1] and self.model[1] + room >= self.lost[0]

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --prove --json``."""
        return {
            "msg_id": f"0x{self.msg_id:04x}",
            "name": self.name,
            "sent": self.sent,
            "lost": list(self.lost),
            "model": list(self.model),
            "outside": self.outside,
            "explained": self.explained,
        }


@dataclass(frozen=True, slots=True)
class CaptureProof:
    """What the model says of a capture.

    Attributes:
        span: seconds into the capture that were judged.
        rows: the MsgIds that lost any.
        not_modelled: why nothing was emulated; empty where it was.
        remedy: the advice of the worst loss; empty where the model cannot try it.
        promised: messages that the doctor said would be left; None where it did not.
        remains: at least and at most lost with the advice,
        advised: and of which MsgId.
        run: the first run, for the picture.
        seen_ns: MsgId to when its messages came out, in the capture.
    """

    span: tuple[float, float]
    rows: Sequence[ProofRow] = ()
    not_modelled: str = ""
    remedy: str = ""
    promised: int | None = None
    remains: tuple[int, int] = (0, 0)
    advised: int = -1
    run: ModelRun = field(default_factory=lambda: ModelRun(Counter(), {}))
    seen_ns: dict[int, list[int]] = field(default_factory=dict)

    @property
    def explained(self) -> bool:
        """Whether the model explains what was lost."""
        return not self.not_modelled and all(row.explained for row in self.rows)

    @property
    def keeps_promise(self) -> bool:
        """Whether the advice keeps what the doctor promised."""
        return self.promised is not None and self.remains[0] <= self.promised + _ROOM

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --prove --json``."""
        return {
            "start_s": round(self.span[0], 3),
            "end_s": round(self.span[1], 3),
            "explained": None if self.not_modelled else self.explained,
            "not_modelled": self.not_modelled or None,
            "advice": self.remedy or None,
            "promised": self.promised,
            "left": list(self.remains) if self.promised is not None else None,
            "kept": self.keeps_promise if self.promised is not None else None,
            "routes": [row.as_json() for row in self.rows],
        }


def window(found: Diagnosis) -> tuple[int, int]:
    """Return from when to when a capture is judged: ns since 1970."""
    if found.end_ns - found.start_ns <= WINDOW_NS:
        return found.start_ns, found.end_ns
    losses = [item for item in found.verdicts if item.lost]
    worst = max(losses, key=lambda item: item.lost or 0, default=None)
    middle = (worst.start_ns + worst.end_ns) // 2 if worst else found.start_ns
    start = min(max(middle - WINDOW_NS // 2, found.start_ns), found.end_ns - WINDOW_NS)
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
        rows = case.rows
        to_ci = among(rows.link, lambda link: link.only_to_cfs)
        extended = bool((rows.header_length[to_ci] == WITH_EXTENDED.command_bytes).mean() > 1 / 2)
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
            extended_header=extended,
            msg_id_version=case.mission.msg_ids.version,
        )
        lengths = {stream.msg_id: int(np.median(rows.cdr_length[stream.rows])) for stream in case.streams}
        two = bool(peers)
        arm = lengths.get(SingleRobotApp.command) == _POSE_BYTES or (
            two and max((lengths.get(item, 0) for item in TwoRobotApp.states), default=0) > _STATE_BYTES
        )
        kinds: dict[tuple[bool, bool], Scenario] = {
            (False, False): "rover",
            (False, True): "arm",
            (True, False): "two-rovers",
            (True, True): "two-arms",
        }
        self.scenario = kinds[two, arm]

    def run(self, phase: int, read_ns: int, stimuli: Sequence[Stimulus], profile: SimProfile) -> ModelRun:
        """Let datagrams go in once.

        Args:
            phase: half rounds by which it begins later.
            read_ns: how long Command Ingest takes for a datagram.
            stimuli: what goes in.
            profile: the constants.
        """
        first = min([item.time_ns for item in stimuli[:1]] + [self._span[0]])
        late = phase * profile.ci_wake_ns // 2
        simulation = Simulation(
            replace(profile, seed=profile.seed + phase, ci_read_ns=read_ns),
            self.scenario,
            start_ns=first - _BOOTED_NS + late,
            bridges=False,
            with_account=True,
        )
        cfs = simulation.cfs
        for item in stimuli:
            simulation.feed(
                item.time_ns, cfs.sbn_endpoint if item.over_network else cfs.ci_endpoint, item.payload
            )
        end_ns = max(self._span[1], stimuli[-1].time_ns if stimuli else 0) + _DRAINS_NS
        for _ in simulation.run(end_ns):
            pass
        return self._count(simulation, stimuli, end_ns)

    def _count(self, simulation: Simulation, stimuli: Sequence[Stimulus], end_ns: int) -> ModelRun:
        start_ns, stop_ns = self._span[0], end_ns - _DRAINS_NS
        commands = Counter(item.msg_id for item in stimuli if not item.over_network)
        usual = max(commands, key=lambda item: commands[item], default=-1)
        ci = socket(simulation.cfs.profile.ci_port)
        lost: Counter[int] = Counter()
        arrived: dict[int, list[int]] = {}
        for item in simulation.cfs.account.arrivals:
            if not start_ns <= item.begin_ns <= stop_ns + SECOND:
                continue
            msg_id = usual if item.hop == ci else item.msg_id
            if item.end in LOST:
                lost[msg_id] += 1
            elif item.end is QueueEnd.DELIVERED and item.hop != ci:
                arrived.setdefault(msg_id, []).append(item.end_ns)
        edoras = simulation.apps.edoras
        if isinstance(edoras, SingleRobotApp):
            read = sum(
                item.end is QueueEnd.DELIVERED
                for item in simulation.cfs.account.arrivals
                if item.msg_id == edoras.command
            )
            lost[edoras.command] += max(0, read - edoras.robot_commands)
        return ModelRun(lost, arrived)


def prove(found: Diagnosis, case: Case, stimuli: Sequence[Stimulus], span: tuple[int, int]) -> CaptureProof:
    """Hold the judged part of a capture against the emulated cFS.

    Args:
        found: the diagnosis of that part.
        case: what it was judged by.
        stimuli: what went into cFS then, and shortly before.
        span: from when to when, ns since 1970.
    """
    seconds = (span[0] - found.zero_ns) / SECOND, (span[1] - found.zero_ns) / SECOND
    if why := _not_modelled(case):
        return CaptureProof(seconds, not_modelled=why)
    model = Model(case, *span)
    runs = [model.run(*item, stimuli, model.profile) for item in _RUNS]
    rows = _rows(found, case, runs)
    proof = CaptureProof(seconds, rows, run=runs[0], seen_ns=_out_times(case, {row.msg_id for row in rows}))
    for verdict in sorted(found.verdicts, key=lambda item: -(item.lost or 0)):
        trial = _trial(verdict, model.profile, stimuli) if verdict.lost and verdict.advice else None
        if trial is not None and verdict.msg_id is not None:
            others = [model.run(*item, trial.stimuli, trial.profile) for item in _RUNS[:2]]
            promised = _promised(found, verdict)
            if promised is not None:
                remains = _range(others, verdict.msg_id)
                return replace(
                    proof, remedy=trial.remedy, promised=promised, remains=remains, advised=verdict.msg_id
                )
    return proof


def _range(runs: Sequence[ModelRun], msg_id: int) -> tuple[int, int]:
    numbers = [run.lost[msg_id] for run in runs]
    return min(numbers), max(numbers)


def _not_modelled(case: Case) -> str:
    """Return what the emulated cFS has no application for; empty where it has all."""
    modelled = {SingleRobotApp.command, *TwoRobotApp.commands, *TwoRobotApp.states}
    others = sorted(
        {
            stream.msg_id
            for stream in case.streams
            if stream.link.to_cfs
            and stream.is_command
            and stream.known_id not in MSG_ID_NAMES
            and stream.known_id not in modelled
            and stream.known_id != case.profile.generator_msg_id
            and any(hop.into is stream for hop in case.hops)
        }
    )
    if others:
        return f"0x{others[0]:04x} goes to an application that is not EDORAS's"
    pipes = sorted(item.pipe for item in case.reported_losses if not item.pipe.startswith(_PIPES))
    return f"{pipes[0]} is of an application that is not EDORAS's" if pipes else ""


def _rows(found: Diagnosis, case: Case, runs: Sequence[ModelRun]) -> list[ProofRow]:
    numbers: dict[int, list[int]] = {}
    unknown = 0
    for row in found.balance:
        if row.msg_id is None:  # may be of any
            unknown += row.all_lost + row.unaccounted + row.uncertain
            continue
        outside = sum(number for cause, number in row.lost.items() if cause in _OUTSIDE)
        own = numbers.setdefault(row.msg_id, [0, 0, 0, 0])
        own[0] = max(own[0], row.came)
        own[1] += row.all_lost + row.unaccounted - outside
        own[2] += row.uncertain + row.shared
        own[3] += outside
    table_rows = []
    for msg_id, (sent, lost, more, outside) in sorted(numbers.items()):
        model = _range(runs, msg_id)
        if lost or model[1] or outside:
            table_rows.append(
                ProofRow(msg_id, case.name(msg_id), sent, (lost, lost + more + unknown), model, outside)
            )
    return table_rows


def _out_times(case: Case, msg_ids: set[int]) -> dict[int, list[int]]:
    """Return when what went in under each MsgId came out, or came out under it."""
    times: dict[int, list[int]] = {}
    for hop in case.hops:
        if hop.into.msg_id in msg_ids:
            times.setdefault(hop.into.msg_id, []).extend(
                case.rows.time_ns[hop.out.rows[hop.out_rows]].tolist()
            )
    for stream in case.streams:
        if stream.link.from_cfs and stream.msg_id in msg_ids and stream.counted:
            times.setdefault(stream.msg_id, []).extend(case.rows.time_ns[stream.rows].tolist())
    return times


class Trial(NamedTuple):
    """What is done as an advice says.

    Attributes:
        remedy: what, in words.
        stimuli: what goes in then.
        profile: the constants then.
    """

    remedy: str
    stimuli: Sequence[Stimulus]
    profile: SimProfile


def _promised(found: Diagnosis, verdict: Verdict) -> int | None:
    """Return how many the doctor said would be left of what a verdict tells of."""
    problem = next((item for item in summarize(found).problems if verdict in item.verdicts), None)
    return problem.left if problem is not None else None


def _trial(verdict: Verdict, profile: SimProfile, stimuli: Sequence[Stimulus]) -> Trial | None:
    """Return what a verdict advises, done; None where the model cannot try it."""
    text, msg_id = verdict.advice.remedy if verdict.advice else "", verdict.msg_id
    if msg_id is not None and (raised := re.search(r"raise TO's limit for it to (\d+)", text)):
        limits = {**profile.to_limits, msg_id: int(raised[1])}
        return Trial(raised[0], stimuli, replace(profile, to_limits=limits))
    if not any(item.msg_id == msg_id for item in stimuli):
        return None
    if slower := re.search(r"send at most ([\d.]+) Hz", text):
        return Trial(slower[0], _spaced(stimuli, msg_id, round(SECOND / float(slower[1]))), profile)
    if spread := re.search(r"at most (\d+) in (\d+) ms", text):
        gap_ns = int(spread[2]) * MILLISECOND // int(spread[1])
        return Trial(spread[0], _spaced(stimuli, msg_id, gap_ns), profile)
    return None


def _spaced(stimuli: Sequence[Stimulus], msg_id: int | None, gap_ns: int) -> list[Stimulus]:
    """Return the same with so much time between two of a MsgId: each as early as that lets it."""
    moved, last = [], 0
    for item in stimuli:
        if item.msg_id == msg_id:
            last = max(item.time_ns, last + gap_ns)
            moved.append(item._replace(time_ns=last))
        else:
            moved.append(item)
    return sorted(moved, key=lambda item: item.time_ns)
