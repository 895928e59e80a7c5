"""One run: a capture that was read to its end, with the data for comparisons and drafts.

The queue model estimates how much a loss would vary in other runs of the same traffic:

1. The arrivals are those of the capture. The exact times of the reading rounds are unknown, so the model runs
   with ``_PHASES`` phases of the round.
2. It is chance whether a reader takes the first messages of a burst while the rest still arrives; then fewer
   are lost than in the model. So each loss of the model happens with the observed share (binomial).
3. If the model loses fewer messages than were lost, or if no queue lost them, it does not apply: such losses
   are taken as independent of each other (Poisson).
"""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.addons.runs.figures import Figures, Parts
from edoras_tools.addons.runs.observation import Examined, Subject, examine_or_count
from edoras_tools.addons.runs.values import TopicValues, ValueCount
from edoras_tools.cfs import queues
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.advice import Arrivals, published_into
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import FILE_SUFFIXES
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.messages import open_inputs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.pipelines.capture.record import CaptureReport
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.reading import ReadLoop
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.text import Progress

_PACKED = ("", ".gz", ".zst")


_PHASES: Final = 16
_LEAST: Final = 1.0
"""Least variance of losses: at both ends of a run their number varies by chance."""
_FITS: Final = 1.2
"""Largest number of actual losses that the model explains, as a multiple of its own losses."""


def loss_spreads(diagnosis: Diagnosis | None) -> dict[tuple[str, int, int], float]:
    """Return the standard deviation of the number of lost messages, for each stream with losses.

    Returns:
        The deviations by link label, MsgId and spacecraft.
    """
    spreads: dict[tuple[str, int, int], float] = {}
    parts = (diagnosis.parts or {FIRST_SPACECRAFT: diagnosis}) if diagnosis else {}
    for number, case in ((number, part.case) for number, part in parts.items()):
        for stream in case.streams if case is not None else ():
            lost = sum(item.lost for item in case.losses_of(stream)) if case is not None else 0
            if case is None or not lost:
                continue
            key = stream.link.label, stream.msg_id, number
            variance = max(_LEAST, _variance(_model(case, stream), lost))
            spreads[key] = sqrt(spreads.get(key, 0.0) ** 2 + variance)
    return spreads


def _model(case: Case, stream: Stream) -> list[int]:
    """Return the losses of a stream in its queues, at each phase."""
    profile = case.profile
    if stream.link.only_to_cfs:
        rows = np.flatnonzero((case.rows.link == stream.link) & (case.rows.destination == stream.receiver))
        arrivals = Arrivals(case.rows.time_ns[rows], case.rows.msg_id[rows].astype(np.int64))
        way = queues.ci_socket(profile), queues.application_pipe(profile)
        return arrivals.lost(way, stream.msg_id, _PHASES)
    if stream.link.only_from_cfs:
        limit = case.commanded_limit(stream)
        pipe = queues.telemetry_pipe(profile)
        return published_into(case, stream).lost(
            (pipe.with_limit(stream.msg_id, limit),), stream.msg_id, _PHASES
        )
    return []


def _variance(model: list[int], lost: int) -> float:
    most = max(model, default=0)
    if lost > _FITS * most:
        return float(lost)
    share = min(1.0, lost / most)
    return float(np.var(model)) * share * share + most * share * (1 - share)


class ValueCounting(Counting):
    """Counts datagrams and values; see ``Counting``.

    Attributes:
        values: values of the configured topics.
    """

    def __init__(self, source: Source, bench: Workbench) -> None:
        super().__init__(source, bench)
        self.values = ValueCount()

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Count the chosen rows of a batch; return those that count."""
        own = super().add(rows, loop)
        self.values.add(own)
        return own


class Run(msgspec.Struct, frozen=True):
    """The results of one run.

    Attributes:
        name: name of its capture.
        report: counts.
        context: context with mission and decoding.
        findings: diagnosis, or the counts of messages.
        values: values of the fields of each topic.
        spreads: standard deviation of the losses in other runs of this traffic, by link, MsgId and
            spacecraft.
    """

    name: str
    report: CaptureReport
    context: Context
    findings: Examined
    values: Mapping[str, TopicValues]
    spreads: Mapping[tuple[str, int, int], float]

    @classmethod
    def read(
        cls, source: Source, bench: Workbench, *, scope: Scope | None = None, progress: Progress | None = None
    ) -> Run:
        """Read a source to its end; the source is closed."""
        counting = ValueCounting(source, bench)
        findings = examine_or_count(source, bench, counting, scope=scope, progress=progress)
        spreads = loss_spreads(findings.diagnosis)
        context = bench.columns.context
        return cls(source.info.name, counting.report, context, findings, counting.values.topics, spreads)

    @property
    def ledger(self) -> Ledger:
        """Counts by route."""
        return self.report.ledger

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Diagnosis; None for a recording without datagrams."""
        return self.findings.diagnosis

    def parts(self) -> Parts:
        """Return the sources of figures."""
        return Parts(self.ledger, self.diagnosis)

    def spread(self, subject: Subject | None = None, *, captured: bool = False) -> float:
        """Return the standard deviation of the losses of some messages; of all by default.

        Args:
            captured: whether only losses in front of the capture count: commands are lost behind it.
        """
        if subject is None:
            return hypot(*self.spreads.values())
        routes = [self.context.mission.routes[index] for index in subject.packets.routes]
        own = {(route.link.label, route.msg_id) for route in routes if not (captured and route.to_cfs)}
        ids = {key.msg_id for key in subject.packets.keys}
        pairs = ((key, value) for key, value in self.spreads.items() if key[2] == subject.spacecraft)
        return hypot(*(value for key, value in pairs if key[:2] in own or key[1] in ids))

    def whole(self) -> Figures:
        """Return the figures of all messages."""
        return Figures.whole(self.ledger, self.diagnosis)


def run_paths(paths: Sequence[Path]) -> list[Path]:
    """Return the named captures, and those in named folders; a rosbag2 folder is one capture.

    Raises:
        ConfigError: a folder has no capture.
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
