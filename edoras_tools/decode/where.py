"""Filters: an expression over the fields of packets, evaluated on columns as far as columns go.

``and`` asks what is cheap first, so that few packets are left for what is not: first what the decoder's
columns hold, then what is gathered from the bytes, then ROS messages in bulk, and last what only the
dissection of each packet tells. See ``docs/filters.md`` for the language.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.decode.where_compare import Misfit, Test, test_of
from edoras_tools.decode.where_names import Names, Unknown
from edoras_tools.decode.where_rows import ColumnRows, Rows
from edoras_tools.decode.where_series import Kind
from edoras_tools.decode.where_syntax import (
    Comparison,
    Junction,
    Negation,
    Node,
    Operand,
    Presence,
    WhereError,
    parse,
    parse_names,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.where_field import Field
    from edoras_tools.model import Columns, Decoded, PacketBatch


class Where:
    """A compiled filter.

    Args:
        text: the expression.
        context: what packets are decoded with; gives names their fields.
        begin_ns: what ``time`` counts from; None: the first datagram that is asked about.

    Raises:
        WhereError: it is no expression, names no field, or compares what cannot be compared.
    """

    def __init__(self, text: str, context: Context, begin_ns: int | None = None) -> None:
        self.text = text
        self.context = context
        self._begin_ns = begin_ns
        self._node = _compile(parse(text), text, Names(context))

    def __str__(self) -> str:
        return self.text

    def mask(
        self, batch: PacketBatch, columns: Columns, chosen: NDArray[Any] | None = None
    ) -> NDArray[np.bool_]:
        """Return which packets of a batch pass.

        Batches come in the order they were captured: ``time`` counts from the first datagram of the first.

        Args:
            batch: datagrams.
            columns: what was decoded from them.
            chosen: look only at these rows; the result then has one element for each of them.
        """
        if self._begin_ns is None and len(batch):
            self._begin_ns = int(batch.time_ns[0])
        rows = slice(None) if chosen is None else chosen
        return self._node.mask(ColumnRows(self.context, self._begin_ns or 0, batch, columns, rows))

    def judge(self, packets: Sequence[Decoded]) -> NDArray[np.bool_]:
        """Return which single packets pass: the same answer as :meth:`mask`, without columns."""
        if self._begin_ns is None and packets:
            self._begin_ns = packets[0].datagram.time_ns
        return self._node.mask(Rows(self.context, self._begin_ns or 0, packets))


class _Test:
    """What every node of a compiled filter is.

    Attributes:
        price: cost of its dearest field.
    """

    price: int

    def mask(self, rows: Rows) -> NDArray[np.bool_]:
        """Return which rows pass."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class _Compared(_Test):
    """One field, which may be of several types, against constants.

    ``every``: the packet has a value and none of them fails; else one value that passes is enough.
    """

    tests: Sequence[tuple[Field, Test]]
    every: bool
    price: int

    def mask(self, rows: Rows) -> NDArray[np.bool_]:
        hit, failed = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
        for field, test in self.tests:
            series = rows.series(field)
            passed = test(series)
            hit |= series.where(passed)
            if self.every:
                failed |= series.where(~passed)
        return hit & ~failed


@dataclass(frozen=True, slots=True)
class _Present(_Test):
    fields: Sequence[Field]
    price: int

    def mask(self, rows: Rows) -> NDArray[np.bool_]:
        there = np.zeros(len(rows), bool)
        for field in self.fields:
            there |= rows.series(field).present()
        return there


@dataclass(frozen=True, slots=True)
class _Not(_Test):
    node: _Test
    price: int

    def mask(self, rows: Rows) -> NDArray[np.bool_]:
        return ~self.node.mask(rows)


@dataclass(frozen=True, slots=True)
class _Joined(_Test):
    """All of some nodes, or one of them; ``steps`` groups nodes of one price, the cheapest first."""

    steps: Sequence[Sequence[_Test]]
    every: bool
    price: int

    def mask(self, rows: Rows) -> NDArray[np.bool_]:
        join = np.logical_and if self.every else np.logical_or
        whole = np.full(len(rows), self.every)
        for step in self.steps:
            left = np.flatnonzero(whole == self.every)
            part = rows if len(left) == len(rows) else rows.take(left)
            if not len(part):
                break
            whole[left] = join.reduce([node.mask(part) for node in step])
        return whole


def _compile(node: Node, text: str, names: Names) -> _Test:
    match node:
        case Negation():
            inner = _compile(node.of, text, names)
            return _Not(inner, inner.price)
        case Junction():
            nodes = sorted((_compile(item, text, names) for item in node.of), key=lambda item: item.price)
            steps = [tuple(group) for _, group in groupby(nodes, key=lambda item: item.price)]
            return _Joined(steps, node.every, nodes[-1].price)
        case Presence():
            fields = _fields(node.operand, text, names)
            return _Present(fields, max(field.price for field in fields))
        case Comparison():
            return _comparison(node, text, names)


def fields(text: str, context: Context, option: str = "--fields") -> list[tuple[str, list[Field]]]:
    """Return what names between commas mean: each name, and its field, or several that share it.

    Raises:
        WhereError: one is no field, or a group of fields.
    """
    names, found = Names(context), []
    for operand in parse_names(text, option):
        items = _fields(operand, text, names, option)
        if all(item.kind is Kind.STRUCT for item in items):
            why = _is_group(items[0], names)
            raise WhereError(text, operand.at, operand.end, why, option)
        found.append((items[0].name, items))
    return found


def _fields(operand: Operand, text: str, names: Names, option: str = "--where") -> list[Field]:
    try:
        found = [replace(field, name=operand.name) for field in names.find(operand.name)]
    except Unknown as error:
        raise WhereError(text, operand.at, operand.end, str(error), option) from None
    if operand.wrap != "len":
        return found
    counted = [item.length() for item in found if item.many or item.kind in {Kind.TEXT, Kind.BYTES}]
    if not counted:
        why = f"len counts what is in a list or a text; {operand.name} is neither"
        raise WhereError(text, operand.at, operand.end, why, option)
    return counted


def _is_group(field: Field, names: Names) -> str:
    inside = names.inside(field)
    hint = f"; name one of its fields: {', '.join(inside[:3])}" if inside else ""
    return f"{field.name} is {field.kind.value}, not a value{hint}"


def _comparison(node: Comparison, text: str, names: Names) -> _Test:
    operand = node.operand
    fields = _fields(operand, text, names)
    tests: list[tuple[Field, Test]] = []
    misfit: Misfit | None = None
    for field in fields:
        try:
            tests.append((field, test_of(field, node)))
        except Misfit as error:
            misfit = misfit or error
    if not tests and misfit is not None:
        if fields[0].kind is Kind.STRUCT:
            raise WhereError(text, operand.at, operand.end, _is_group(fields[0], names))
        place = misfit.value or node
        raise WhereError(text, place.at, place.end, misfit.why)
    every = operand.wrap == "all" or (operand.wrap != "any" and node.operator in {"!=", "not in"})
    return _Compared(tests, every, max(field.price for field, _ in tests))
