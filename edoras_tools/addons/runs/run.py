"""One run: a capture that was read to its end, with the data for comparisons and drafts.

The queue model estimates how much a loss would vary in other runs of the same traffic:

1. The arrivals are those of the capture. The exact times of the reading rounds are unknown, so the model runs
   with ``_PHASES`` phases of the round.
2. It is chance whether a reader takes the first messages of a burst while the rest still arrives; then fewer
   are lost than in the model. So each loss of the model happens with the observed share (binomial).
3. If the model loses fewer messages than were lost, or if no queue lost them, it does not apply: such losses
   are taken as independent of each other (Poisson).

The fields of each topic are collected, too:

1. Numbers are compared, including those in nested structs, and in lists of up to ``_ELEMENTS`` if all
   messages have the same length. Texts and stamps are not: times differ in each run.
2. The values of at most ``_MOST`` messages of a topic are kept, to name the first one that differs; range and
   mean include all messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import hypot, sqrt
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.runs.check import Examined, Figures, Parts, Subject, examine_or_count
from edoras_tools.cfs import queues
from edoras_tools.decode.lines import message_rows, read_whole
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.advice import Arrivals, published_into
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import FILE_SUFFIXES
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.ros.cdr.bulk import Ragged

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.pipelines.capture.record import CaptureReport
    from edoras_tools.pipelines.doctor import Scope
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
    cases = {number: part.case for number, part in parts.items() if part.case is not None}
    for number, case in cases.items():
        for stream in case.streams:
            if lost := sum(item.lost for item in case.losses_of(stream)):
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
        pipe = queues.telemetry_pipe(profile).with_limit(stream.msg_id, case.commanded_limit(stream))
        return published_into(case, stream).lost((pipe,), stream.msg_id, _PHASES)
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
        values: values of the fields of each configured topic.
    """

    def __init__(self, source: Source, bench: Workbench) -> None:
        super().__init__(source, bench)
        self.values: dict[str, TopicValues] = {}

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Count the chosen rows of a batch; return those that count."""
        chosen = super().add(rows, loop)
        for _, own in chosen.by_spacecraft():
            routes = {route.topic: route for route in own.context.mission.routes}
            for item in message_rows(own, read_whole(own), commands=False):
                if item.topic not in routes or item.bound is not None or not item.columns.valid.any():
                    continue
                valid = np.flatnonzero(item.columns.valid)
                topic = self.values.setdefault(item.topic, TopicValues(routes[item.topic].to_cfs))
                part = own.take(item.owner[valid])
                topic.note(part.datagram("number"), part.datagram("time_ns"))
                for name, values in _columns(item.columns.fields):
                    topic.fields.setdefault(name, FieldValues()).add(values[valid])
        return chosen


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
        return cls(source.info.name, counting.report, context, findings, counting.values, spreads)

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


_ELEMENTS: Final = 16
_MOST: Final = 100_000
_TIME: Final = ("sec", "nanosec")
_END: Final = 0.05
_MOVED: Final = 0.8
"""Least distance from the first to the last value of a still moving field, as a share of its range."""
_FEWEST: Final = 20


class FieldValues(msgspec.Struct):
    """One field of a topic.

    Attributes:
        low: lowest value; infinite without a number.
        high: highest value.
        count: number of finite values.
        first_values: f64 (n,), values of the first messages.
        is_whole: whether it is a whole number or a flag.
        is_flag: whether it is true or false.
    """

    low: float = np.inf
    high: float = -np.inf
    count: int = 0
    is_whole: bool = False
    is_flag: bool = False
    _sum: float = 0.0
    _first_values: list[NDArray[np.float64]] = msgspec.field(default_factory=list)
    _kept_count: int = 0

    def add(self, values: NDArray[Any]) -> None:
        """Add the values of some messages, (n,)."""
        self.is_whole, self.is_flag = values.dtype.kind in "iub", values.dtype.kind == "b"
        numbers = values.astype(np.float64)
        if (room := _MOST - self._kept_count) > 0:
            self._first_values.append(numbers[:room])
            self._kept_count += len(numbers[:room])
        numbers = numbers[np.isfinite(numbers)]
        self.count += len(numbers)
        self._sum += float(numbers.sum())
        self.low = min(self.low, float(numbers.min(initial=np.inf)))
        self.high = max(self.high, float(numbers.max(initial=-np.inf)))

    @property
    def mean(self) -> float:
        """Mean of the finite values."""
        return self._sum / self.count

    @property
    def first_values(self) -> NDArray[np.float64]:
        """Values of the first messages, f64 (n,)."""
        return np.concatenate([np.zeros(0), *self._first_values])

    @property
    def is_constant(self) -> bool:
        """Whether all values are equal."""
        return self.low == self.high

    @property
    def is_moving(self) -> bool:
        """Whether the field still reached new extremes when the run ended: a longer run would go further."""
        values = self.first_values
        if self.is_constant or len(values) < _FEWEST:
            return not self.is_constant
        late = (1 - _END) * len(values)
        goes_on = np.nanargmax(values) >= late or np.nanargmin(values) >= late
        return bool(goes_on and abs(values[-1] - values[0]) > _MOVED * (self.high - self.low))


class TopicValues(msgspec.Struct):
    """The fields of one topic.

    Attributes:
        to_cfs: whether its messages go to cFS.
        fields: fields by name; elements of lists as ``position[0]``.
    """

    to_cfs: bool = False
    fields: dict[str, FieldValues] = msgspec.field(default_factory=dict)
    _numbers: list[NDArray[np.int64]] = msgspec.field(default_factory=list)
    _times_ns: list[NDArray[np.int64]] = msgspec.field(default_factory=list)

    def place(self, message: int) -> tuple[int, int]:
        """Return number and time of a message, counted from 0."""
        return int(np.concatenate(self._numbers)[message]), int(np.concatenate(self._times_ns)[message])

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """Times of the kept messages, i64 (n,), ns since 1970."""
        return np.concatenate([np.zeros(0, np.int64), *self._times_ns])

    def note(self, numbers: NDArray[np.int64], times_ns: NDArray[np.int64]) -> None:
        """Record the numbers and times of further messages."""
        if sum(map(len, self._numbers)) < _MOST:
            self._numbers.append(numbers)
            self._times_ns.append(times_ns)


def _columns(fields: Mapping[str, NDArray[Any] | Ragged]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the numbers of some messages, one column each."""
    for name, column in fields.items():
        before, _, last = name.rpartition(".")
        if last in _TIME and all((f"{before}.{item}" if before else item) in fields for item in _TIME):
            continue
        if isinstance(column, Ragged):
            lengths = np.diff(column.offsets)
            if not len(lengths) or lengths.min() != lengths.max() or not lengths[0]:
                continue
        values = column.values.reshape(len(lengths), -1) if isinstance(column, Ragged) else column
        if values.dtype.kind not in "iufb":
            continue
        if values.ndim == 1:
            yield name, values
        else:
            for place in range(min(values.shape[1], _ELEMENTS)):
                yield f"{name}[{place}]", values[:, place]
