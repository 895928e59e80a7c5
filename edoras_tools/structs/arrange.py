"""Computes the offsets of struct members as a C compiler does, for layouts written without offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.structs.shapes import Member


@dataclass(frozen=True, slots=True)
class Wanted:
    """A member whose offset is to be computed.

    Attributes:
        member: its offset and bit count only where it is ``placed``.
        size: bytes of one element.
        alignment: what its offset must be a multiple of.
        placed: whether the layout gives its offset.
    """

    member: Member
    size: int
    alignment: int
    placed: bool


def arrange(
    wanted: Iterable[Wanted], *, union: bool = False, packed: bool = False
) -> tuple[list[Member], int, int]:
    """Compute the offset of every member, as the System V ABI does.

    Args:
        wanted: in the order of the declaration.
        union: all members start at 0.
        packed: no padding at all.

    Returns:
        the members, the bytes of the struct with its padding, and its alignment.
    """
    members: list[Member] = []
    bit, end, widest = 0, 0, 1  # the next free bit, and the end of the members so far
    for item in wanted:
        alignment = 1 if packed else item.alignment
        widest = max(widest, alignment)
        member, unit = item.member, 8 * item.size
        if union:
            bit = 0
        if item.placed:
            bit = 8 * member.offset + member.bit
        elif not member.bits:
            bit = -(-bit // (8 * alignment)) * 8 * alignment
        elif not packed and bit % unit + member.bits > unit:
            bit = -(-bit // unit) * unit  # a bit-field does not straddle units of its type
        members.append(replace(member, offset=bit // 8, bit=bit % 8 if member.bits else 0))
        bit += member.bits or 8 * item.size * prod(member.array)
        end = max(end, -(-bit // 8))
    return members, -(-end // widest) * widest, widest
