"""Sorts and groups rows by key."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

Integers: TypeAlias = "NDArray[np.int64]"
"""Times in ns, counts, or places in a buffer of bytes."""
Mask: TypeAlias = "NDArray[np.bool_]"
"""A selection of the elements of another array."""
Octets: TypeAlias = "NDArray[np.uint8]"
"""Bytes, or small numbers as the codes of links."""
Places: TypeAlias = "NDArray[np.intp]"
"""Indices of the elements of another array."""
Prints: TypeAlias = "NDArray[np.uint64]"
"""Fingerprints; 0 is unknown."""
_Item = TypeVar("_Item")
_Key = TypeVar("_Key")
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)
_WIDE: Final = 1 << 31
"""Limit of numbers of which a pair fits into 63 bits."""
_SLOTS: Final = 18
"""Most bits of the lookup table that is used while distinct values are few."""
_SLOTS_EACH: Final = 3
"""Bits of the table beyond those that number the rows: a large table is too slow for few rows."""


def order_by(*keys: NDArray[np.integer]) -> Integers:
    """Return the stable order that groups equal keys; keys are u8, u16 or u32, radix sorted."""
    digits: list[NDArray[np.uint16]] = []
    room = 0  # the largest factor for the last digit; a sort costs the same for each digit
    for key in keys:
        least, most = _bounds(key)
        size = most - least + 1
        moved = key - key.dtype.type(least)
        if 1 < size <= room:
            digits[-1] = digits[-1] * np.uint16(size) + moved.astype(np.uint16)
            room //= size
        elif size > 1:
            digits.append(moved.astype(np.uint16))
            room = 0x10000 // size
            if size > 0x10000:
                digits.append((moved >> 16).astype(np.uint16))
    return np.arange(len(keys[0])) if not digits else np.lexsort(digits)


def in_16_bits(values: NDArray[Any]) -> NDArray[Any]:
    """Return non-negative numbers in 16 bits if they fit: radix sort is then several times as fast."""
    return values.astype(np.uint16) if values.max(initial=0) <= 0xFFFF else values


def changes(rows: Places, *columns: NDArray[Any]) -> Mask:
    """Return whether a column changes at each of some rows; True for the first row."""
    out = np.zeros(len(rows), np.bool_)
    out[:1] = True
    for column in columns:
        if (column != column[:1]).any():
            own = column[rows]
            out[1:] |= own[1:] != own[:-1]
    return out


def numbered(*keys: NDArray[Any]) -> tuple[Places, Places]:
    """Number the distinct rows of some columns of integers, in order of first occurrence.

    Nothing is sorted while there are few distinct rows, as is usual for kinds of traffic.

    Returns:
        The first row of each, and the number of each row: ``numpy.unique``'s index and inverse.
    """
    if len(keys) == 1:
        return _numbered(keys[0])
    whole, size = np.zeros(len(keys[0]), np.intp), 1
    for part, span in map(_from_zero, keys):
        if size * span > _WIDE * _WIDE:
            whole, size = _numbered(whole)[1], len(whole)
        whole, size = whole * span + part, size * span
    return _numbered(whole)


def _numbered(values: NDArray[Any]) -> tuple[Places, Places]:
    rows = np.arange(len(values))
    least, most = _bounds(values)
    if least == most:
        return rows[:1], np.zeros(len(rows), np.intp)
    if most - least >= len(values):
        first_rows = _first_rows(values)
        first = np.flatnonzero(first_rows == rows)
        rows[first] = np.arange(len(first))
        return first, rows[first_rows]
    place, size = _from_zero(values)
    table = np.full(size, -1)
    table[place[::-1]] = rows[::-1]  # numpy keeps the last of several values: the first row
    first = np.sort(table[table >= 0])
    table[place[first]] = np.arange(len(first))
    return first, table[place]


def _bounds(values: NDArray[Any]) -> tuple[int, int]:
    return (int(values.min()), int(values.max())) if len(values) else (0, 0)


def _from_zero(values: NDArray[Any]) -> tuple[Places, int]:
    """Return integers minus the smallest, and the size of their range; a wide range is numbered."""
    least, most = _bounds(values)
    if most - least >= _WIDE:
        return _numbered(values)[1], len(values)
    wide = values if values.dtype.itemsize == 8 else values.astype(np.intp)
    return (wide - wide.dtype.type(least)).astype(np.intp, copy=False), most - least + 1


def _first_rows(values: NDArray[Any], mix: int = int(_MIX)) -> Places:
    """Return the first row with the value of each row, by hashes; on a collision another hash is used."""
    bits = min(_SLOTS, len(values).bit_length() + _SLOTS_EACH)
    place = ((values.astype(np.uint64) * np.uint64(mix)) >> np.uint64(64 - bits)).astype(np.intp)
    table = np.empty(1 << bits, np.intp)  # only written elements are read
    table[place[::-1]] = np.arange(len(values))[::-1]
    met = table[place]
    if len(others := np.flatnonzero(values[met] != values)):
        met[others] = others[_first_rows(values[others], mix * int(_MIX) % (1 << 64))]
    return met


def perhaps_in(
    values: Prints, others: Prints, kinds: Octets | None = None, fits: Prints | None = None
) -> Mask:
    """Return which fingerprints are among others, and perhaps a few more: nothing is sorted.

    Args:
        kinds: kind of each of the others, below 64.
        fits: bit mask of the kinds that each fingerprint may match; by default any.
    """
    bits = min(_SLOTS, len(others).bit_length() + _SLOTS_EACH)
    table, shift = np.zeros(1 << bits, np.uint64), np.uint64(64 - bits)
    slots = others * _MIX >> shift
    for kind, rows in by_value(np.zeros(len(others), np.uint8) if kinds is None else kinds):
        table[slots[rows]] |= np.uint64(1 << kind)
    met = table[values * _MIX >> shift]
    return np.asarray((met if fits is None else met & fits) != 0)


def distinct_rows(values: NDArray[Any]) -> tuple[NDArray[Any], Places, Places]:
    """Return ``numpy.unique`` of one column with its index and inverse.

    ``numpy.unique`` imports ``numpy.ma``, which takes longer than the work of a short command.
    """
    first, which = numbered(values)
    order = np.argsort(values[first])
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    first = first[order]
    return values[first], first, place[which]


def distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return ``numpy.unique`` of one column; it is sixty times as fast if many values differ."""
    ranked = np.sort(values)
    new: Mask = np.append(True, ranked[1:] != ranked[:-1])
    return np.asarray(ranked[new[: len(ranked)]])


def by_value(values: NDArray[Any]) -> Iterator[tuple[int, Places]]:
    """Yield each distinct value with the indices of its elements."""
    least, most = _bounds(values)
    if least == most:
        if len(values):
            yield least, np.arange(len(values))
        return
    is_small = least >= 0 or values.dtype.itemsize <= 2
    order = np.argsort(in_16_bits(values) if is_small else values, kind="stable")
    ends = np.flatnonzero(np.diff(values[order])) + 1
    for first, end in pairwise([0, *ends.tolist(), len(order)]):  # ``numpy.split`` takes longer
        yield int(values[order[first]]), order[first:end]


def groups(values: NDArray[Any], rows: Places) -> Iterator[tuple[int, Places]]:
    """Yield each distinct value of a column among some rows, with the rows that have it."""
    for value, at in by_value(values[rows]):
        yield value, rows[at]


def by_key(items: Iterable[_Item], key: Callable[[_Item], _Key]) -> dict[_Key, list[_Item]]:
    """Group items by key; keys and items are in their original order."""
    groups: dict[_Key, list[_Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def quantiles(values: NDArray[Any], *shares: float) -> list[float]:
    """Return ``numpy.quantile`` of at least one value; it is several times as fast for few values."""
    ranked = np.sort(values)
    values_at = []
    for share in shares:
        place = (len(ranked) - 1) * share
        low = int(place)
        below, above = ranked[low], ranked[min(low + 1, len(ranked) - 1)]
        part = place - low
        step = above - below
        values_at.append(float(above - step * (1 - part) if part >= 0.5 else below + step * part))
    return values_at
