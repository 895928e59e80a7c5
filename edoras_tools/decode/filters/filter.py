"""Filters: an expression over the fields of packets, evaluated on columns as far as possible.

``and`` evaluates the cheapest operand first, so that few packets are left for the expensive ones: first the
decoder's columns, then fields read from the bytes, then ROS messages in bulk, and last fields that need the
dissection of each packet. See ``docs/filters.md`` for the language.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.filters import syntax
from edoras_tools.decode.filters.compare import Misfit, Test, test_of
from edoras_tools.decode.filters.names import Names, Unknown
from edoras_tools.decode.filters.rows import ColumnRows, PacketRows, ValueKind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.field import FilterField
    from edoras_tools.model import Columns, Decoded, PacketBatch
    from edoras_tools.wire.arrays.order import Mask


class Where:
    """A compiled filter.

    Args:
        context: context that packets are decoded with; its fields have names.
        begin_ns: zero of ``time``; None: the first datagram of the first batch.
        names: names of the context's fields, to share them between many filters.

    Raises:
        WhereError: the text is no expression, names no field, or compares values that cannot be compared.
    """

    def __init__(
        self, text: str, context: Context, begin_ns: int | None = None, names: Names | None = None
    ) -> None:
        self.text = text
        self.context = context
        self._begin_ns = begin_ns
        self._node = _compile(syntax.parse_filter(text), text, names or Names(context))

    def __str__(self) -> str:
        return self.text

    def mask(self, batch: PacketBatch, columns: Columns, selection: NDArray[Any] | None = None) -> Mask:
        """Return which packets of a batch pass.

        Batches come in the order they were captured: ``time`` counts from the first datagram of the first.

        Args:
            selection: rows to test; the result then has one element for each of them.
        """
        if self._begin_ns is None and len(batch):
            self._begin_ns = int(batch.time_ns[0])
        rows = slice(None) if selection is None else selection
        return self.passing(ColumnRows(self.context, self._begin_ns or 0, batch, columns, rows))

    def passing(self, rows: ColumnRows) -> Mask:
        """Return which of some rows pass; values read for another filter are not read again."""
        return self._node.mask(rows)

    def judge(self, packets: Sequence[Decoded]) -> Mask:
        """Return which single packets pass: the same answer as :meth:`mask`, without columns."""
        if self._begin_ns is None and packets:
            self._begin_ns = packets[0].datagram.time_ns
        return self._node.mask(PacketRows(self.context, self._begin_ns or 0, packets))


class _Test(msgspec.Struct, frozen=True):
    """Base of the nodes of a compiled filter.

    Attributes:
        price: highest cost of its fields.
    """

    price: int

    def mask(self, rows: PacketRows) -> Mask:
        """Return which rows pass."""
        raise NotImplementedError


class _Compared(_Test, frozen=True):
    """One field, which may be of several types, compared with constants.

    ``every``: the packet has a value and no value fails; else one value that passes is enough.
    """

    tests: Sequence[tuple[FilterField, Test]]
    every: bool

    def mask(self, rows: PacketRows) -> Mask:
        hit, failed = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
        for field, test in self.tests:
            series = field.series(rows)
            passed = test(series)
            hit |= series.where(passed)
            if self.every:
                failed |= series.where(~passed)
        return hit & ~failed


class _Present(_Test, frozen=True):
    fields: Sequence[FilterField]

    def mask(self, rows: PacketRows) -> Mask:
        present = np.zeros(len(rows), bool)
        for field in self.fields:
            present |= field.series(rows).present()
        return present


class _Not(_Test, frozen=True):
    node: _Test

    def mask(self, rows: PacketRows) -> Mask:
        return ~self.node.mask(rows)


class _Joined(_Test, frozen=True):
    """All or any of some nodes must hold; ``steps`` groups nodes of one price, the cheapest first."""

    steps: Sequence[Sequence[_Test]]
    every: bool

    def mask(self, rows: PacketRows) -> Mask:
        join = np.logical_and if self.every else np.logical_or
        whole = np.full(len(rows), self.every)
        for step in self.steps:
            undecided = np.flatnonzero(whole == self.every)
            part = rows if len(undecided) == len(rows) else rows.take(undecided)
            if not len(part):
                break
            whole[undecided] = join.reduce([node.mask(part) for node in step])
        return whole


def _compile(node: syntax.Expression, text: str, names: Names) -> _Test:
    match node:
        case syntax.Negation():
            inner = _compile(node.of, text, names)
            return _Not(inner.price, inner)
        case syntax.Junction():
            nodes = sorted((_compile(item, text, names) for item in node.of), key=lambda item: item.price)
            steps = [tuple(group) for _, group in groupby(nodes, key=lambda item: item.price)]
            return _Joined(nodes[-1].price, steps, node.every)
        case syntax.Presence():
            fields = _fields(node.operand, text, names)
            return _Present(max(field.price for field in fields), fields)
        case syntax.Comparison():
            return _comparison(node, text, names)


def fields(text: str, context: Context, option: str = "--fields") -> list[tuple[str, list[FilterField]]]:
    """Return the fields of comma-separated names: each name, and its field, or several that share it.

    Raises:
        WhereError: one is not a field, or a group of fields.
    """
    names, pairs = Names(context), []
    for operand in syntax.parse_names(text, option):
        items = _fields(operand, text, names, option)
        if all(item.kind is ValueKind.STRUCT for item in items):
            raise syntax.WhereError(text, operand.at, operand.end, _is_group(items[0], names), option)
        pairs.append((items[0].name, items))
    return pairs


def _fields(operand: syntax.Operand, text: str, names: Names, option: str = "--where") -> list[FilterField]:
    try:
        matches = [replace(field, name=operand.name) for field in names.find(operand.name)]
    except Unknown as error:
        raise syntax.WhereError(text, operand.at, operand.end, str(error), option) from None
    if operand.wrap != "len":
        return matches
    lengths = [
        item.length() for item in matches if item.many or item.kind in {ValueKind.TEXT, ValueKind.BYTES}
    ]
    if not lengths:
        why = f"len counts what is in a list or a text; {operand.name} is neither"
        raise syntax.WhereError(text, operand.at, operand.end, why, option)
    return lengths


def _is_group(field: FilterField, names: Names) -> str:
    inside = names.inside(field)
    hint = f"; name one of its fields: {', '.join(inside[:3])}" if inside else ""
    return f"{field.name} is {field.kind.value}, not a value{hint}"


def _comparison(node: syntax.Comparison, text: str, names: Names) -> _Test:
    operand = node.operand
    fields = _fields(operand, text, names)
    tests: list[tuple[FilterField, Test]] = []
    misfit: Misfit | None = None
    for field in fields:
        try:
            tests.append((field, test_of(field, node)))
        except Misfit as error:
            misfit = misfit or error
    if not tests and misfit is not None:
        if fields[0].kind is ValueKind.STRUCT:
            raise syntax.WhereError(text, operand.at, operand.end, _is_group(fields[0], names))
        place = misfit.value or node
        raise syntax.WhereError(text, place.at, place.end, misfit.why)
    every = operand.wrap == "all" or (operand.wrap != "any" and node.operator in {"!=", "not in"})
    return _Compared(max(field.price for field, _ in tests), tests, every)
