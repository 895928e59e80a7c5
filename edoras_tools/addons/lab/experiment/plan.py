"""The plan of an experiment, from a YAML file.

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

Paths are relative to the plan. All errors of a file are reported at once, with file, line and key.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import asdict

from edoras_tools.addons.lab.emulator import SCENARIOS
from edoras_tools.cfs.profile import constant_names
from edoras_tools.mission.tree import Mistakes, ScalarNode, SequenceNode, Tree, named_entries, read_document
from edoras_tools.sessions.faults.kinds import hertz, natural, probability, time_ns
from edoras_tools.units import SECOND
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

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
