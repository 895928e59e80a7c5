"""The fields of each topic in a run: range, mean, and the values of the first messages.

1. Numbers are compared, including those in nested structs, and in lists of up to ``_ELEMENTS`` if all
   messages have the same length. Texts and stamps are not: times differ in each run.
2. The values of at most ``_MOST`` messages of a topic are kept, to name the first one that differs; range and
   mean include all messages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.decode.contents import message_rows, read_whole
from edoras_tools.ros.cdr.columns import Ragged

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from edoras_tools.decode.filters.rows import ColumnRows

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


class ValueCount:
    """Collects the values of the configured topics while a capture is read.

    Attributes:
        topics: values by topic.
    """

    def __init__(self) -> None:
        self.topics: dict[str, TopicValues] = {}

    def add(self, rows: ColumnRows) -> None:
        """Add some rows."""
        for _, own in rows.by_spacecraft():
            routes = {route.topic: route for route in own.context.mission.routes}
            for item in message_rows(own, read_whole(own), commands=False):
                if item.topic not in routes or item.bound is not None or not item.columns.valid.any():
                    continue
                valid = np.flatnonzero(item.columns.valid)
                topic = self.topics.setdefault(item.topic, TopicValues(routes[item.topic].to_cfs))
                part = own.take(item.owner[valid])
                topic.note(part.datagram("number"), part.datagram("time_ns"))
                for name, values in _columns(item.columns.fields):
                    topic.fields.setdefault(name, FieldValues()).add(values[valid])


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
