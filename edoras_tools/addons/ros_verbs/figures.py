"""Rate, bandwidth and delay of a topic over its last messages, printed as ``ros2 topic`` prints them.

Times between messages are those of receiving, or of the capture. Bandwidth is the size of all messages of
the window except the first, divided by the time from the first to the last. So no figure depends on the time
of the query.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.ros_verbs.messages import MessageBlock
    from edoras_tools.ros import TypeStore

    Kind = Literal["hz", "bw", "delay"]

USUAL_WINDOWS: Final = {"hz": 10_000, "bw": 100, "delay": 10_000}
"""Default numbers of messages, as in ``ros2 topic``."""
_UNITS: Final = ((1_000_000, "MB", 2), (1_000, "KB", 2), (1, "B", 0))
_HEAD: Final = ("topic", "rate", "min_delta", "max_delta", "std_dev", "window")


class TopicFigures:
    """The figures of one topic.

    Args:
        kind: kind of figures.
        topic: name of the topic.
        window: number of messages; for rates, number of intervals.
    """

    def __init__(self, kind: Kind, topic: str, window: int) -> None:
        self.kind, self.topic = kind, topic
        self._messages, self._window = 0, window + (kind == "hz")
        self._times = self._values = np.zeros(0, np.int64)

    def add(self, block: MessageBlock, types: TypeStore) -> None:
        """Add messages of the topic.

        Raises:
            ConfigError: the delay is requested, and the messages have no header.
        """
        values = block.length
        if self.kind == "delay":
            stamps = block.stamps(types)
            if stamps is None:
                raise ConfigError(f"{block.topic}: {block.type} has no header: nothing says when it was made")
            values = block.time_ns - stamps
        self._messages += len(values)
        self._times = np.concatenate([self._times, block.time_ns])[-self._window :]
        self._values = np.concatenate([self._values, values])[-self._window :]

    def as_json(self) -> dict[str, Any]:
        """Return the figures in the shape of ``topic.schema.json``."""
        gaps = np.diff(self._times)
        row: dict[str, Any] = {"topic": self.topic, "messages": self._messages}
        if self.kind == "bw":
            size, span_ns = self._values, int(gaps.sum())
            rate = float(size[1:].sum()) * SECOND / span_ns if span_ns > 0 else None
            spread = _spread(size, "bytes")
            del spread["std_dev_bytes"]
            return row | {"window": len(size), "bytes_per_s": rate} | spread
        seconds = (gaps if self.kind == "hz" else self._values) / SECOND
        row |= {"window": len(seconds)} | _spread(seconds, "s")
        if self.kind == "hz":
            row["rate_hz"] = 1 / row["mean_s"] if row["mean_s"] else None
        return row

    def text(self) -> str:
        """Return the output of ``ros2 topic``; empty if there is none yet."""
        row = self.as_json()
        if len(self._values) < (1 if self.kind == "delay" else 2):
            return ""
        if self.kind == "bw":
            rate = row["bytes_per_s"] or 0.0
            size, unit, digits = next((item for item in _UNITS if rate >= item[0]), _UNITS[-1])
            mean, least, most, rate = (
                f"{value / size:.{digits}f} {unit}"
                for value in (row["mean_bytes"], row["min_bytes"], row["max_bytes"], rate)
            )
            start = f"{rate}/s from {row['window']} messages"
            return f"{start}\n\tMessage size mean: {mean} min: {least} max: {most}"
        name, value = ("rate", row["rate_hz"] or 0.0) if self.kind == "hz" else ("delay", row["mean_s"])
        return (
            f"average {name}: {value:.3f}\n\tmin: {row['min_s']:.3f}s max: {row['max_s']:.3f}s "
            f"std dev: {row['std_dev_s']:.5f}s window: {row['window']}"
        )


def _spread(values: NDArray[Any], unit: str) -> dict[str, Any]:
    """Return mean, minimum, maximum and standard deviation; None for no values."""
    names = (f"{name}_{unit}" for name in ("mean", "min", "max", "std_dev"))
    stats = (values.mean(), values.min(), values.max(), values.std()) if len(values) else (None,) * 4
    return {name: None if item is None else float(item) for name, item in zip(names, stats, strict=True)}


def rate_table(figures: Sequence[TopicFigures]) -> str:
    """Return the rates of several topics in the form of ``ros2 topic hz``; empty if there are none."""
    rows = []
    for item in figures:
        entry = item.as_json()
        if item.text():
            parts = (f"{entry[name] or 0:.3f}" for name in ("rate_hz", "min_s", "max_s"))
            rows.append([item.topic, *parts, f"{entry['std_dev_s']:.5f}", str(entry["window"])])
    width = [max(len(row[at]) for row in (_HEAD, *rows)) for at in range(len(_HEAD))]
    head = "   ".join(name.center(size) for name, size in zip(_HEAD, width, strict=True))
    body = ["   ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) for row in rows]
    return "\n".join([head, "=" * len(head), *body, ""]) if rows else ""
