"""Filters: an expression over the fields of packets, evaluated on columns as far as possible.

``and`` evaluates the cheapest operand first, so that few packets are left for the expensive ones: first the
decoder's columns, then fields read from the bytes, then ROS messages in bulk, and last fields that need the
dissection of each packet. See ``docs/filters.md`` for the language.

A comparison reads its constant according to the field, and tests whole series of values.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Sequence
from datetime import datetime
from difflib import get_close_matches
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.filters import syntax
from edoras_tools.decode.filters.names import Names, Unknown
from edoras_tools.decode.filters.rows import ColumnRows, FilterField, PacketRows, Series, ValueKind
from edoras_tools.decode.filters.syntax import Comparison, Value, ValueRange
from edoras_tools.decode.spacecraft import split_topic
from edoras_tools.older import UTC

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.model import Columns, Decoded, PacketBatch
    from edoras_tools.wire.arrays import Mask


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
    lengths = [one.length() for one in matches if one.many or one.kind in {ValueKind.TEXT, ValueKind.BYTES}]
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


Test = Callable[[Series], "Mask"]
"""Tests every value of a series; returns bool (values,)."""

_INTEGER: Final = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]+|\d+)")
_REAL: Final = re.compile(r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|inf|nan)")
_DURATION: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(ns|us|ms|s|m|h|d)?")
_UNITS: Final = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": 10**9,
    "m": 60 * 10**9,
    "h": 3600 * 10**9,
    "d": 86400 * 10**9,
}
_MOMENT: Final = re.compile(r"(\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d)?)?)(?:\.(\d{1,9}))?(?:Z| UTC)?")
_ORDERS: Final[dict[str, Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_MOST: Final = 1 << 64


class Misfit(Exception):  # noqa: N818  it never leaves the compiler
    """A constant or an operator that does not suit a field.

    Attributes:
        why: reason, one line.
        value: the constant; None if the operator is wrong.
    """

    def __init__(self, why: str, value: Value | None = None) -> None:
        super().__init__(why)
        self.why = why
        self.value = value


def test_of(field: FilterField, comparison: Comparison) -> Test:
    """Return the test of one field's values for a comparison.

    ``!=`` and ``not in`` accept a packet if each of its values differs.

    Raises:
        Misfit: the field cannot be compared like that.
    """
    if field.kind is ValueKind.STRUCT:
        raise Misfit(f"{field.name} is not a value")
    symbol, items = comparison.operator, comparison.items
    if symbol == "matches":
        return _matches(field, items[0])
    if symbol == "contains":
        return _contains(field, items[0])
    if symbol in {"in", "not in"}:
        tests = [_item(field, item) for item in items]
        inside = (
            tests[0] if len(tests) == 1 else lambda series: np.any([test(series) for test in tests], axis=0)
        )
        return inside if symbol == "in" else lambda series: ~inside(series)
    return _ordered(field, symbol, _single(items[0]))


def _single(item: Value | ValueRange) -> Value:
    assert isinstance(item, Value), "only in takes a range"
    return item


def _item(field: FilterField, item: Value | ValueRange) -> Test:
    if isinstance(item, Value):
        return _ordered(field, "==", item)
    low, high = _ordered(field, ">=", item.low), _ordered(field, "<=", item.high)
    if field.kind in {ValueKind.NUMBER, ValueKind.DURATION, ValueKind.MOMENT}:
        bottom, top = constant(field, item.low), constant(field, item.high)
        if bottom > top:
            raise Misfit(f"the range ends before it begins: {item.low.text}..{item.high.text}", item.low)
    return lambda series: low(series) & high(series)


def _ordered(field: FilterField, symbol: str, value: Value) -> Test:
    if field.kind in {ValueKind.TEXT, ValueKind.BYTES}:
        return _text_equal(field, symbol, value)
    if field.kind is ValueKind.BOOL and symbol not in {"==", "!="}:
        raise Misfit(f"{field.name} is {field.kind.value}: compare it with == or !=")
    number_of = constant(field, value)
    exact = symbol in {"==", "!="} and field.limits is not None
    if exact and not field.limits[0] <= number_of <= field.limits[1]:  # type: ignore[index]  # exact says it is there
        span = " to ".join(f"{item:#x}" if field.base == 16 else str(item) for item in field.limits or ())
        raise Misfit(f"{field.name} is never {value.text}: it holds {span}", value)
    if field.dtype.kind == "f":
        number = float(np.float32(number_of)) if field.dtype.itemsize == 4 else float(number_of)
        return lambda series: _ORDERS[symbol](series.values, number)
    if symbol == "!=":
        same = _ordered(field, "==", value)
        return lambda series: ~same(series)
    low, high = _bounds(symbol, number_of)
    return lambda series: _within(series.values, low, high)


def _bounds(symbol: str, limit: float) -> tuple[float, float]:
    """Return the smallest and the largest integer that compare like that with a number."""
    if math.isnan(limit):
        return math.inf, -math.inf
    down, up = (limit, limit) if math.isinf(limit) else (math.floor(limit), math.ceil(limit))
    if symbol == "==":
        return up, down
    if symbol in {"<", "<="}:
        return -math.inf, up - 1 if symbol == "<" else down
    return down + 1 if symbol == ">" else up, math.inf


def _within(values: NDArray[Any], low: float, high: float) -> Mask:
    """Return which integers lie between two limits, whatever their width; bools are 0 and 1."""
    if values.dtype == bool:
        values = values.view(np.uint8)
    limits = np.iinfo(values.dtype)
    if low > limits.max or high < limits.min or low > high:
        return np.zeros(len(values), bool)
    if low == high:
        return values == values.dtype.type(low)
    inside = np.ones(len(values), bool)
    if low > limits.min:
        inside &= values >= values.dtype.type(low)
    if high < limits.max:
        inside &= values <= values.dtype.type(high)
    return inside


def constant(field: FilterField, value: Value) -> Any:
    """Return the number that a word means for a field.

    Raises:
        Misfit: it means none.
    """
    text = value.text
    if field.kind is ValueKind.MOMENT:
        return _moment(field, value)
    if value.quoted and not (field.names or field.words):
        raise Misfit(f"{field.name} is {field.kind.value}, and {_quote(text)} is text", value)
    if field.kind is ValueKind.BOOL:
        truth = {"true": 1, "false": 0, "1": 1, "0": 0}.get(text.lower())
        if truth is None:
            raise Misfit(f"{field.name} is true or false, not {text}", value)
        return truth
    if field.kind is ValueKind.DURATION:
        match = _DURATION.fullmatch(text)
        if match is None:
            raise Misfit(f"{field.name} is a length of time, as 1.5s, 250ms or 10m, not {text!r}", value)
        return _bounded(round(float(match[1]) * _UNITS[match[2] or "s"]), value)
    words = {name.lower(): number for number, name in field.names.items()} | dict(field.words)
    if text.lower() in words:
        return words[text.lower()]
    number = _number(text)
    if number is None:
        raise Misfit(_no_number(field, text), value)
    return _bounded(number, value)


def _no_number(field: FilterField, text: str) -> str:
    words = [*field.names.values(), *(word.upper() for word in field.words)]
    if not words:
        return f"{field.name} is a number, and {text!r} is none"
    if len(words) > 10:
        by_lower = {word.lower(): word for word in words}
        words = [by_lower[near] for near in get_close_matches(text.lower(), by_lower, 3, 0.5)]
    return f"{field.name} has no {text!r}" + (f"; there are {', '.join(words)}" if words else "")


def _number(text: str) -> int | float | None:
    if _INTEGER.fullmatch(text):
        digits = text.lstrip("+-").lower()
        size = int(digits, 16) if digits.startswith("0x") else int(digits) if len(digits) < 400 else 2 * _MOST
        return -size if text.startswith("-") else size
    return float(text) if _REAL.fullmatch(text) else None


def _bounded(number: float, value: Value) -> float:
    if math.isfinite(number) and abs(number) > _MOST and isinstance(number, int):
        raise Misfit(f"{value.text[:20]}... is beyond every field", value)
    return number


def _moment(field: FilterField, value: Value) -> int:
    """Return ns since 1970 of a date and time, or of seconds since then."""
    match = _MOMENT.fullmatch(value.text)
    if match is not None:
        try:
            moment = datetime.fromisoformat(match[1]).replace(tzinfo=UTC)
        except ValueError as error:
            raise Misfit(f"{value.text!r} is not a time: {error}", value) from None
        return int(moment.timestamp()) * 10**9 + int((match[2] or "").ljust(9, "0"))
    number = None if value.quoted else _number(value.text)
    if number is None or not math.isfinite(number):
        example = "2026-11-21T06:14:00.5"
        raise Misfit(f"{field.name} is a point in time, as {example}, not {value.text!r}", value)
    return int(_bounded(round(number * 10**9), value))


def _lifted(holds: Callable[[Any], bool]) -> Test:
    """Make a test of many texts from a test of one; each distinct text is tested once."""

    def test(series: Series) -> Mask:
        table = series.table or ()
        return np.fromiter(map(holds, table), bool, len(table))[series.values]

    return test


def _text_equal(field: FilterField, symbol: str, value: Value) -> Test:
    if symbol not in {"==", "!="}:
        kind = "a number" if _number(value.text) is not None and not value.quoted else "text"
        also = f", and {value.text} is {kind}" if kind == "a number" else ""
        raise Misfit(
            f"{field.name} is {field.kind.value}{also}; "
            f"{symbol} compares numbers, text takes ==, !=, in, contains and matches"
        )
    if field.kind is ValueKind.BYTES:
        expected = _bytes(field, value)
        if symbol == "==":
            return _lifted(lambda item: item == expected)
        return _lifted(lambda item: item != expected)
    word, alike = value.text, field.alike or operator.eq
    words = {word, split_topic(word)[1]}
    if field.choices and not any(alike(text, item) for text in field.choices for item in words):
        near = get_close_matches(word, field.choices, 3, 0.5) or field.choices[:5]
        raise Misfit(f"{field.name} is never {word!r}; there are {', '.join(near)}", value)
    if symbol == "==":
        return _lifted(lambda text: alike(text, word))
    return _lifted(lambda text: not alike(text, word))


def _contains(field: FilterField, item: Value | ValueRange) -> Test:
    value = _single(item)
    if field.kind is ValueKind.BYTES:
        part = _bytes(field, value)
        return _lifted(lambda item: part in item)
    if field.kind is ValueKind.TEXT:
        return _lifted(lambda text: value.text in text)
    if field.many:
        return _ordered(field, "==", value)
    raise Misfit(f"contains looks into text, bytes and lists; {field.name} is {field.kind.value}")


def _matches(field: FilterField, item: Value | ValueRange) -> Test:
    value = _single(item)
    if field.kind is not ValueKind.TEXT:
        raise Misfit(f"matches looks into text; {field.name} is {field.kind.value}")
    try:
        pattern = re.compile(value.text)
    except (re.error, RecursionError, OverflowError) as error:
        raise Misfit(f"{_quote(value.text)} is not a regular expression: {error}", value) from None
    return _lifted(lambda text: pattern.search(text) is not None)


def _bytes(field: FilterField, value: Value) -> bytes:
    digits = re.sub(r"[\s:]|^0x", "", value.text)
    try:
        return bytes.fromhex(digits)
    except ValueError:
        raise Misfit(
            f"{field.name} is bytes: write them in hex, as 00:01:ff, not {value.text!r}", value
        ) from None


def _quote(text: str) -> str:
    return f'"{text}"' if len(text) <= 40 else f'"{text[:40]}..."'
