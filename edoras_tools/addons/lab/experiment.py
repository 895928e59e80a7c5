"""Experiments: many runs of a system under several settings, from a plan in a YAML file.

::

    scenario: [rover, two-rovers]  # emulated ones; or target: HOST:PORT of a real cFS, which needs a replay
    mission: [rover_ground.yaml]   # by default the scenario's own
    replay: drive.mcap             # commands to send; by default an operator sends at the rate
    to: ci                         # the link that they go to
    settings:                      # each with each
      rate: [5, 10]                # commands a second
      app_msg_limit: [4, 8]        # a constant of the emulated cFS: edoras help decoding lists them
    duration: 30s                  # of a run without replay
    runs: 5..40                    # of each cell: at least, and at most
    width: 1%                      # no more runs once the loss of every topic is known to this, either way
    seed: 1

Paths are relative to the plan. All errors of a file are reported at once, with file, line and key. Each run
is recorded, diagnosed and kept, so that an experiment can be resumed:

1. A run is ``DIR/CELL/NNN.mcap`` and ``NNN.json``. Without the second file it is repeated.
2. Phases and latencies follow from the plan's seed, the cell and the number of the run: a repeated run is
   equal.
3. Commands begin some time after the run's start and end before its end, so that counters cover all of them.
4. A cell has enough runs when the loss of every topic has the plan's precision, or at the plan's maximum.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import product
from math import inf
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import asdict, replace

from edoras_tools.addons.lab.emulator import BOOT_NS, SCENARIOS, Simulation
from edoras_tools.addons.lab.emulator.cfs import mission_profile, routes_of, with_limit
from edoras_tools.addons.lab.emulator.simulation import (
    SimulatedSource,
    SimulatedWire,
    SimulationSource,
    demo_bench,
)
from edoras_tools.cfs.profile import constant_names
from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.errors import ConfigError, EdorasError, InterruptError
from edoras_tools.intervals import mean_interval
from edoras_tools.io.net.sockets import parse_endpoint
from edoras_tools.io.outputs import write_bytes
from edoras_tools.links.table import carrying
from edoras_tools.mission.tree import Mistakes, ScalarNode, SequenceNode, Tree, named_entries, read_document
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.sending.options import Receiver, SendOptions, receiver
from edoras_tools.pipelines.sending.replay import ReplaySelection, changes_for, load_datagrams
from edoras_tools.pipelines.sending.run import SentRecording, Transmission
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files
from edoras_tools.sessions.faults.rules import hertz, natural, probability, time_ns
from edoras_tools.units import SECOND
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.sending.loop import SendReport

RATE: Final = "rate"
_KEYS: Final = (
    *("schema", "scenario", "target", "mission", "replay", "to"),
    *("settings", "duration", "runs", "width", "seed"),
)
_FORM: Final = "a plan names a scenario or a target, settings and runs"


class Cell(msgspec.Struct, frozen=True):
    """One combination of a scenario and settings.

    Attributes:
        scenario: scenario of an emulated cFS; empty for a real one.
        settings: name to value.
    """

    scenario: str
    settings: Mapping[str, float]

    @property
    def name(self) -> str:
        """Name, also of its folder: ``rover,rate=5``."""
        values = [f"{name}={value:.15g}" for name, value in self.settings.items()]
        return ",".join([self.scenario or "target", *values])


class ExperimentPlan(msgspec.Struct, frozen=True):
    """The combinations to run, and the number of runs.

    Attributes:
        scenarios: emulated scenarios; empty if there is a target.
        target: address of a real cFS, as ``HOST:PORT``; empty if cFS is emulated.
        missions: mission files; empty: the scenario's own.
        replay: capture whose commands are sent; None: an operator sends commands.
        to: link of the commands.
        settings: name to the values to try.
        duration_ns: duration of a run without a replay, ns.
        least: least number of runs of each cell.
        most: most runs of a cell, if its loss does not become precise enough before.
        width: required precision: half the width of the interval of each topic's loss share; 0: make all
            runs.
        seed: seed of phases and latencies.
    """

    scenarios: Sequence[str] = ()
    target: str = ""
    missions: Sequence[Path] = ()
    replay: Path | None = None
    to: str = "ci"
    settings: Mapping[str, Sequence[float]] = msgspec.field(default_factory=dict)
    duration_ns: int = 30 * SECOND
    least: int = 5
    most: int = 5
    width: float = 0.0
    seed: int = 1

    def cells(self) -> Iterator[Cell]:
        """Yield every scenario with every combination of settings."""
        for scenario, *values in product(self.scenarios or ("",), *self.settings.values()):
            settings: Any = dict(zip(self.settings, values, strict=True))
            yield Cell(str(scenario), settings)

    def as_json(self) -> dict[str, Any]:
        """Return the values that determine a run; the numbers of runs may change when a plan is resumed."""
        return {name: value for name, value in asdict(self).items() if name not in {"least", "most", "width"}}


def load_plan(path: Path) -> ExperimentPlan:
    """Read a plan.

    Raises:
        ConfigError: all errors at once, each with file, line and key.
    """
    report = Mistakes(str(path))
    tree = read_document(path, report, _FORM, one="a plan is one document", instead="a plan")
    values = _Reader(report, path.parent).values(tree) if tree is not None else {}
    if tree is not None and not report.mistakes:
        if bool(values.get("scenarios")) == bool(values.get("target")):
            report.mistake(tree.line, "", f"scenario or target is needed, and not both; {_FORM}")
        if values.get("target") and "replay" not in values:
            report.mistake(tree.line, "replay", "a real target needs a capture whose commands are sent")
        constants = [name for name in values.get("settings", ()) if name != RATE]
        if values.get("target") and constants:
            report.mistake(tree.line, f"settings.{constants[0]}", "is set in an emulated cFS alone")
    report.raise_all()
    return ExperimentPlan(**values)


class _Reader:
    """Reads a tree; mistakes go to the report."""

    def __init__(self, report: Mistakes, folder: Path) -> None:
        self.report, self.folder = report, folder

    def values(self, tree: Tree) -> dict[str, Any]:
        """Return the attributes of a plan."""
        values: dict[str, Any] = {}
        single: Mapping[str, tuple[str, Callable[[str], Any]]] = {
            "target": ("target", str),
            "to": ("to", str),
            "replay": ("replay", self._file),
            "duration": ("duration_ns", time_ns),
            "width": ("width", probability),
            "seed": ("seed", natural),
        }
        for key, line, node in named_entries(tree, "", self.report, _FORM, _KEYS):
            if key in single:
                name, read = single[key]
                values |= dict.fromkeys([name], next(iter(self._read(node, key, read)), None))
            elif key == "scenario":
                values["scenarios"] = self._read(node, key, _scenario)
            elif key == "mission":
                values["missions"] = self._read(node, key, self._file)
            elif key == "runs":
                for limits in self._read(node, key, _runs):
                    values["least"], values["most"] = limits
            elif key == "settings":
                values["settings"] = dict(self._settings(node))
            elif not (isinstance(node, ScalarNode) and node.value == 1):
                self.report.mistake(line, key, "this version reads schema 1")
        return values

    def _settings(self, tree: Tree) -> Iterator[tuple[str, list[float]]]:
        names = (RATE, *constant_names())
        for name, line, node in named_entries(tree, "settings", self.report, "a setting needs values"):
            if name not in names:
                near = did_you_mean(name, names, 1)
                near = near or "there are rate, and the constants of edoras help decoding"
                text = f"no such setting; {near}"
                self.report.mistake(line, f"settings.{name}", text)
                continue
            yield name, self._read(node, f"settings.{name}", hertz if name == RATE else natural)

    def _read(self, node: Tree, place: str, read: Callable[[str], Any]) -> list[Any]:
        values = []
        for item in node.items if isinstance(node, SequenceNode) else (node,):
            try:
                values.append(read(item.text if isinstance(item, ScalarNode) else ""))
            except ValueError as error:
                self.report.mistake(item.line, place, str(error))
        return values

    def _file(self, text: str) -> Path:
        path = self.folder / text
        if not path.is_file():
            raise ValueError(f"{path}: there is no such file")
        return path


def _scenario(text: str) -> str:
    if text not in SCENARIOS:
        raise ValueError(f"{text!r} is no scenario; there are {', '.join(SCENARIOS)}")
    return text


def _runs(text: str) -> tuple[int, int]:
    first, dots, last = text.partition("..")
    least, most = natural(first), natural(last if dots else first)
    if not 2 <= least <= most:
        raise ValueError(f"{text!r} is no number of runs; write 10, or 5..40; one run shows no spread")
    return least, most


_PHASES_NS: Final = SECOND
"""Range of the random phase: a whole number of rounds of cFS's tasks."""
_BEGIN_NS: Final = 1_767_225_600 * SECOND
_APART_NS: Final = 600 * SECOND
"""Time between the starts of emulated runs, which begin in 2026."""
BEFORE_COMMANDS_NS: Final = 3 * SECOND
"""Time before the first command, in which counters arrive that show earlier losses."""
AFTER_COMMANDS_NS: Final = 4 * SECOND
"""Time after the last command, in which its counters arrive."""
PLAN, REPORT = "plan.json", "report.json"


def cell_report(cell: Cell, runs: Sequence[Mapping[str, Any]], width: float) -> dict[str, Any]:
    """Return the results of a cell, in the shape of ``experiment --json``.

    Args:
        cell: scenario and settings.
        runs: ``topics`` of each run, by name: ``sent``, ``lost``, ``rate_hz`` and ``delay_ms``.
        width: required precision of the loss; 0: none.
    """
    names = dict.fromkeys(name for run in runs for name in run["topics"])
    topics = [_topic(name, [run["topics"][name] for run in runs if name in run["topics"]]) for name in names]
    losses = [item["loss"] for item in topics if item["loss"]]
    return {
        "cell": cell.name,
        "scenario": cell.scenario or None,
        "settings": dict(cell.settings),
        "runs": len(runs),
        "known": all(item["high"] - item["low"] <= 2 * width for item in losses) if width else None,
        "topics": topics,
    }


def _topic(name: str, figures: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the intervals of a topic's means: loss as a share, rate in Hz, delay in ms."""
    sent = [item["sent"] for item in figures if item["sent"]]
    loss = [item["lost"] / item["sent"] for item in figures if item["sent"]]
    row: dict[str, Any] = {"topic": name, "loss": _interval(loss, 1 / min(sent, default=1), most=1.0)}
    return row | {key: _interval([item[key] for item in figures]) for key in ("rate_hz", "delay_ms")}


def _interval(
    values: Sequence[float | None], step: float = 0.0, most: float = inf
) -> dict[str, float] | None:
    """Return the interval of a mean, within 0 to ``most``; None for fewer than two values."""
    numbers = [item for item in values if item is not None]
    if len(numbers) < 2:
        return None
    mean, low, high = mean_interval(numbers, step)
    return {"mean": mean, "low": max(0.0, low), "high": min(most, high)}


class Experiment:
    """A plan and its folder.

    Args:
        plan: plan.
        folder: folder of the runs; it is created if necessary.

    Raises:
        ConfigError: the folder has runs of another plan, or the plan cannot be carried out.
    """

    def __init__(self, plan: ExperimentPlan, folder: Path) -> None:
        self.plan, self.folder = plan, folder
        plan_path = folder / PLAN
        text = json.dumps(plan.as_json(), indent=1, sort_keys=True, default=str)
        if plan_path.exists() and plan_path.read_text() != text:
            raise ConfigError(f"{folder}: has runs of another plan; name another folder with -o")
        self.benches = {cell.name: CellBench(plan, cell) for cell in plan.cells()}
        write_bytes(plan_path, text.encode(), folders=True)

    def run(self, on_run: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
        """Make the missing runs; write the results of each cell, and return them.

        Args:
            on_run: called before each run, with a text for the user.

        Returns:
            The shape of ``experiment --json``.

        Raises:
            CaptureError: a run cannot be made or written; after Ctrl-C an ``InterruptError``.
        """
        reports = []
        for index, (name, bench) in enumerate(self.benches.items()):
            runs: list[dict[str, Any]] = []
            report = cell_report(bench.cell, runs, self.plan.width)
            while len(runs) < self.plan.most:
                if len(runs) >= self.plan.least and report["known"] is not False:
                    break
                number = len(runs) + 1
                path = self.folder / name / f"{number:03}.mcap"
                result = path.with_suffix(".json")
                if not result.exists():
                    on_run(f"{name}, run {number}")
                    write_bytes(result, json.dumps(bench.run(path, index, number)).encode(), folders=True)
                runs.append(json.loads(result.read_text()))
                report = cell_report(bench.cell, runs, self.plan.width)
            reports.append(report)
        whole = {"schema": 1, "folder": str(self.folder), "cells": reports}
        write_bytes(self.folder / REPORT, json.dumps(whole, indent=1).encode())
        return whole


class CellBench:
    """Makes the runs of one cell."""

    def __init__(self, plan: ExperimentPlan, cell: Cell) -> None:
        self.plan, self.cell = plan, cell
        self._constants = {name: int(value) for name, value in cell.settings.items() if name != RATE}

    @cached_property
    def bench(self) -> Workbench:
        """Workbench with the mission."""
        return demo_bench(self.cell.scenario, Settings(self.plan.missions, constants=self._constants))

    def run(self, path: Path, index: int, number: int) -> dict[str, Any]:
        """Make a run, record it, and return its results and losses."""
        chance = random.Random(f"{self.plan.seed} {self.cell.name} {number}")  # noqa: S311  repeatable
        path.parent.mkdir(parents=True, exist_ok=True)
        account: Sequence[tuple[str, int, str, int]] = ()
        if self.cell.scenario:
            simulation = self.simulation(chance, _BEGIN_NS + (number * 1000 + index) * _APART_NS)
            begin_ns = simulation.now
            target = Target(path, replace=True, jobs=1)
            limits = Limits(clock=lambda: 0)  # the host's time would split the recording anew each time
            _whole(record(self.emulated(simulation), self.bench.fresh(), target, limits=limits).failure)
            losses = sorted(simulation.cfs.account.losses(begin_ns).items())
            account = [(hop, msg_id, end.name, count) for (hop, msg_id, end), count in losses]
        else:
            recording = partial(SentRecording, target=Target(path, replace=True), bench=self.bench.fresh())
            _sent(self._transmission().run(recording=recording))
        opened = open_files([path])
        findings = examine(opened, self.bench.fresh())
        _whole(findings.failure)
        return {"topics": topics_of(findings.diagnosis), "account": account}

    def simulation(self, chance: random.Random, start_ns: int) -> Simulation:
        """Boot an emulated cFS, and let it run up to a random phase of its rounds."""
        profile = mission_profile(self.bench)
        profile = replace(with_limit(profile, profile.to_default_limit), seed=chance.getrandbits(31))
        routes: Any = routes_of(self.bench) if self.plan.missions else self.cell.scenario
        simulation = Simulation(profile, routes, start_ns=start_ns, bridges=False, with_account=True)
        for _ in simulation.run(start_ns + BOOT_NS + chance.randrange(_PHASES_NS)):
            pass
        return simulation

    def emulated(self, simulation: Simulation) -> Source:
        """Return the traffic of a run as a source."""
        if self.plan.replay is None:
            rate, duration_ns = self.cell.settings.get(RATE, 5.0), self.plan.duration_ns
            simulation.connect(
                rate, command_count=round(rate * duration_ns / SECOND), after_ns=BEFORE_COMMANDS_NS
            )
            return SimulatedSource(simulation, BEFORE_COMMANDS_NS + duration_ns + AFTER_COMMANDS_NS)
        transmission = self._transmission()
        is_sbn = transmission.options.to is Receiver.SBN
        target = simulation.cfs.sbn_endpoint if is_sbn else simulation.cfs.ci_endpoint
        answers = carrying("flight" if is_sbn else "ground", to_cfs=False)
        own = transmission.options.listen
        assert own is not None
        wire = SimulatedWire(simulation, target, own, answers, keeps_all=True)
        _sent(transmission.run(wire=wire))
        return SimulationSource(simulation, [wire.carried])

    def _transmission(self) -> Transmission:
        """Return the datagrams to send, and the settings of sending."""
        plan, bench = self.plan, self.bench.fresh()
        assert plan.replay is not None
        target: Endpoint | None = parse_endpoint(plan.target) if plan.target else None
        to, _ = receiver(plan.to, bench.columns.context)
        rate = self.cell.settings.get(RATE)
        waits = ("to-enabled",) if to is Receiver.CI else ()
        options = SendOptions(
            to=to,
            target=target,
            wait_for=waits,
            rates=(("*", rate),) if rate else (),
            confirmed=bool(target),  # the command asks before the first run
        ).placed(bench.mission)
        loaded = load_datagrams(open_files([plan.replay]), bench, options, ReplaySelection())
        changes = changes_for(options, {}, bench.mission, bench.types, restamp=False)
        return Transmission.of(loaded, options, bench.mission, changes)


def _whole(failure: EdorasError | None) -> None:
    """Raise the failure of a run, if any."""
    if failure is not None:
        raise failure


def _sent(report: SendReport) -> None:
    """Raise the failure of sending, if any."""
    _whole(InterruptError("interrupted while it was sent") if report.interrupted else report.failure)


def topics_of(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the figures of each topic: messages, rate in Hz, and the 99th percentile of the delay in ms."""
    rows: dict[str, dict[str, Any]] = {}
    configured = set(diagnosis.topics.values())
    for line in diagnosis.headlines:
        if line.topic in configured:
            row = rows.setdefault(line.topic, {"sent": 0, "lost": 0, "rate_hz": None, "delay_ms": None})
            row["sent"] += line.sent
            row["lost"] += line.missing
    for item in diagnosis.routes:
        if row := rows.get(item["topic"] or "", {}):
            row["rate_hz"] = (row["rate_hz"] or 0.0) + item["rate_hz"]
            delays = [value for value in (row["delay_ms"], latency_ms(item)) if value is not None]
            row["delay_ms"] = max(delays, default=None)
    return rows
