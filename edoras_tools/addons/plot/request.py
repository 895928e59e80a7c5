"""Requests of a plot: ``/cmd_vel.linear.*``, ``/imu.covariance[4]``, ``rate:/cmd_vel``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.older import StrEnum
from edoras_tools.pipelines.export.tables import TableForm, chosen_topics, fits_field
from edoras_tools.pipelines.selection import fits_topic
from edoras_tools.ros.cdr.columns import Ragged
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.columns import TableColumn
    from edoras_tools.pipelines.export.sources import TopicSource

_INDEX: Final = re.compile(r"\[(\d+)\]")
_NUMBERS: Final = "biuf"
_USE: Final = "write /topic.field, rate:/topic or loss:/topic"


class Quantity(StrEnum):
    """The quantity that is drawn of a topic."""

    FIELD = "field"
    RATE = "rate"
    """Messages per second."""
    LOSS = "loss"
    """Lost messages per second, as ``doctor --list-lost`` lists them."""


class PlotRequest(msgspec.Struct, frozen=True):
    """One request.

    Attributes:
        text: text as given.
        quantity: the quantity that is drawn.
        topic: a shell pattern of topics.
        field: a shell pattern of fields, which includes the fields inside them; empty for all.
        index: index of an element in a list; None for all elements.
    """

    text: str
    quantity: Quantity
    topic: str
    field: str = ""
    index: int | None = None

    def topics(self, source: TopicSource, narrowed: Sequence[str]) -> list[str]:
        """Return the topics of an input that this request means.

        Args:
            narrowed: patterns; if there are any, a topic must also match one of them.

        Raises:
            RouteError: there is none, or none is left.
        """
        for pattern in narrowed:
            chosen_topics(source, [pattern], ())
        fitting = chosen_topics(source, [self.topic], ())
        selection = [
            topic for topic in fitting if not narrowed or any(fits_topic(topic, item) for item in narrowed)
        ]
        if not selection:
            raise RouteError(f"{self.text}: --topic leaves out {listed(fitting, 3)}; leave out --topic")
        return selection

    def fields(self, source: TopicSource, topics: Sequence[str]) -> dict[str, list[str]]:
        """Return the fields with numbers that this request means, by topic.

        Raises:
            ConfigError: there is none, or the index does not fit.
        """
        columns_of = {topic: _columns(source, topic, self.field) for topic in topics}
        names = {name: column for columns in columns_of.values() for name, column in columns.items()}
        matches = {
            name: column for name, column in names.items() if not self.field or fits_field(name, self.field)
        }
        where = listed(sorted(topics), 3)
        if not matches:
            hint = did_you_mean(self.field, names, cutoff=0.5) or f"there are {listed([*names], 12)}"
            raise ConfigError(f"{self.text}: {self.field!r} is no field of {where}; {hint}")
        numbers = {name: column for name, column in matches.items() if _kind(column) in _NUMBERS}
        if not numbers:
            raise ConfigError(f"{self.text}: {listed([*matches], 3)} of {where} holds text, not numbers")
        for name, column in numbers.items():
            self._check_index(name, column)
        return {topic: [name for name in columns if name in numbers] for topic, columns in columns_of.items()}

    def _check_index(self, name: str, column: TableColumn) -> None:
        """Check that an index fits a column.

        Raises:
            ConfigError: the field is no list, or its lists have fewer elements.
        """
        values = column.values
        if self.index is None or isinstance(values, Ragged):
            return
        if values.ndim == 1:
            raise ConfigError(f"{self.text}: {name} is one number; leave out [{self.index}]")
        if self.index >= values.shape[1]:
            raise ConfigError(
                f"{self.text}: {name} has {values.shape[1]} elements; use [0] to [{values.shape[1] - 1}]"
            )


def parse_request(text: str) -> tuple[PlotRequest, ...]:
    """Read a request; parts with commas between them share a panel.

    Raises:
        ConfigError: the request cannot be read.
    """
    parts = tuple(_parse_one(part.strip()) for part in text.split(",") if part.strip())
    if not parts:
        raise ConfigError(f"{text!r} cannot be plotted; {_USE}")
    return parts


def _parse_one(text: str) -> PlotRequest:
    name, colon, rest = text.partition(":")
    if colon:
        if name not in (Quantity.RATE, Quantity.LOSS) or not rest:
            raise ConfigError(f"{text!r} cannot be plotted; {_USE}")
        return PlotRequest(text, Quantity(name), rest)
    topic, _, pattern = text.partition(".")
    indices = _INDEX.findall(pattern)
    if len(indices) > 1:
        raise ConfigError(f"{text}: more than one index; lists inside lists are joined, so give one")
    index = int(indices[0]) if indices else None
    return PlotRequest(text, Quantity.FIELD, topic, _INDEX.sub("", pattern), index)


def _columns(source: TopicSource, topic: str, pattern: str) -> dict[str, TableColumn]:
    """Return a topic's columns by name; columns that this package adds, only if the pattern names them."""
    block = source.empty(topic)
    columns = TableForm().columns(block, 0)[1:]
    return {item.name: item for item in columns if item.name in {*block.message.fields, pattern}}


def _kind(column: TableColumn) -> str:
    values = column.values.values if isinstance(column.values, Ragged) else column.values
    return str(np.asarray(values).dtype.kind)
