"""Counts the values of a struct. Each value is copied separately, so their number is limited."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.structs.messages import parts
from edoras_tools.structs.shapes import BasicKind

if TYPE_CHECKING:
    from edoras_tools.structs.shapes import Member, Struct, StructLayout

MOST_VALUES: Final = 1 << 16
"""The most copies that one message may take; a struct with more is a mistake."""


class Counter:
    """Counts the single copies that structs take."""

    def __init__(self, layout: StructLayout) -> None:
        self._layout = layout
        self._known: dict[str, int] = {}

    def fixed(self, struct: Struct) -> int:
        """Return the copies for a packet, without an array that is open to its end."""
        found = parts(self._layout, struct, whole=True)
        return sum(self._of(part.member, part.member.count) for part in found if not part.open)

    def each(self, member: Member) -> int:
        """Return the copies for one element of an array that is open to the end."""
        return self._of(member, 2 * member.row) - self._of(member, member.row) if member.array else 0

    def _of(self, member: Member, count: int) -> int:
        basic = self._layout.basic(member)
        if basic is None:
            return count * self._nested(self._layout.structs[str(member.type)])
        return count if member.text or basic.kind is BasicKind.BOOL else 1

    def _nested(self, struct: Struct) -> int:
        if struct.name not in self._known:
            found = parts(self._layout, struct, whole=False)
            # An empty message is a byte.
            self._known[struct.name] = sum(self._of(part.member, part.member.count) for part in found) or 1
        return self._known[struct.name]
