"""What Python 3.10, that of ROS 2 Humble, does not have yet."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from datetime import timezone
from enum import Enum, IntFlag
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from typing_extensions import Self

if sys.version_info >= (3, 11):
    from enum import StrEnum

    Flags = IntFlag
else:

    class Flags(IntFlag):
        """Bits that can be iterated over, lowest first."""

        def __iter__(self) -> Iterator[Self]:
            return (bit for bit in type(self) if bit & self)

        def __len__(self) -> int:
            return int(self).bit_count()

    class StrEnum(str, Enum):
        """An enumeration of texts; each is its text."""

        __str__ = str.__str__
        __format__ = str.__format__


UTC: Final = timezone.utc

__all__ = ["UTC", "Flags", "StrEnum"]
