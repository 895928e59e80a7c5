"""One run: a capture that was read to its end, and all that is compared of it or drafted from it."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

from edoras_tools.addons.runs.figures import Figures, Parts
from edoras_tools.addons.runs.observation import Examined, Subject, examine_or_count
from edoras_tools.addons.runs.spreads import loss_spreads
from edoras_tools.addons.runs.values import TopicValues, ValueCount
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import FILE_SUFFIXES
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.messages import open_inputs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.pipelines.capture.record import CaptureReport
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.reading import ReadLoop
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.text import Progress

_PACKED = ("", ".gz", ".zst")


class ValueCounting(Counting):
    """Counts datagrams and values; see ``Counting``.

    Attributes:
        values: of the configured topics.
    """

    def __init__(self, source: Source, bench: Workbench) -> None:
        super().__init__(source, bench)
        self.values = ValueCount()

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Count the chosen rows of a batch; return those that count."""
        own = super().add(rows, loop)
        self.values.add(own)
        return own


@dataclass(frozen=True, slots=True)
class Run:
    """What is known of one run.

    Attributes:
        name: of its capture.
        report: its counts.
        context: mission and decoding.
        findings: of the doctor, or of who counts messages.
        values: of the fields of each topic.
        spreads: standard deviation of what is lost of each link and MsgId, in other runs of this traffic.
    """

    name: str
    report: CaptureReport
    context: Context
    findings: Examined
    values: Mapping[str, TopicValues]
    spreads: Mapping[tuple[str, int], float]

    @classmethod
    def read(
        cls, source: Source, bench: Workbench, *, scope: Scope | None = None, progress: Progress | None = None
    ) -> Run:
        """Read a source to its end; the source is closed."""
        counting = ValueCounting(source, bench)
        findings = examine_or_count(source, bench, counting, scope=scope, progress=progress)
        spreads = loss_spreads(findings.diagnosis.case) if findings.diagnosis else {}
        context = bench.columns.context
        return cls(source.info.name, counting.report, context, findings, counting.values.topics, spreads)

    @property
    def ledger(self) -> Ledger:
        """Its counts by route."""
        return self.report.ledger

    @property
    def diagnosis(self) -> Diagnosis | None:
        """What the doctor says; None of a recording without datagrams."""
        return self.findings.diagnosis

    def parts(self) -> Parts:
        """Return what figures are made of."""
        return Parts(self.ledger, self.diagnosis)

    def spread(self, subject: Subject | None = None, *, captured: bool = False) -> float:
        """Return the standard deviation of what is lost of some messages; of all by default.

        Args:
            captured: of how many are captured: what goes to cFS is lost behind the capture.
        """
        if subject is None:
            return hypot(*self.spreads.values())
        routes = [self.context.mission.routes[index] for index in subject.packets.routes]
        own = {(route.link.label, route.msg_id) for route in routes if not (captured and route.to_cfs)}
        ids = {key.msg_id for key in subject.packets.keys}
        return hypot(*(value for key, value in self.spreads.items() if key in own or key[1] in ids))

    def whole(self) -> Figures:
        """Return the figures of all messages."""
        return Figures.whole(self.ledger, self.diagnosis)


def run_paths(paths: Sequence[Path]) -> list[Path]:
    """Return the captures that are named, of folders those in them; a rosbag2 folder is one capture.

    Raises:
        ConfigError: a folder has none.
    """
    endings = tuple(f"{suffix}{packed}" for suffix in FILE_SUFFIXES for packed in _PACKED)
    runs: list[Path] = []
    for path in paths:
        if not path.is_dir() or (path / "metadata.yaml").exists():
            runs.append(path)
            continue
        inside = sorted(item for item in path.rglob("*") if item.is_file() and item.name.endswith(endings))
        if not inside:
            raise ConfigError(
                f"{path}: no capture in it; name files, or folders with {', '.join(FILE_SUFFIXES)}"
            )
        runs += inside
    return runs


def read_runs(
    paths: Sequence[Path], settings: Settings, *, scope: Scope | None = None, progress: Progress | None = None
) -> list[Run]:
    """Read captures, each one run.

    Raises:
        EdorasError: one of them cannot be read to its end.
    """
    runs = []
    for path in run_paths(paths):
        source, bench = open_inputs([path], settings)
        run = Run.read(source, bench, scope=scope, progress=progress)
        if run.findings.failure is not None:
            raise run.findings.failure
        runs.append(run)
    return runs
