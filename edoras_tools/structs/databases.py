"""Files of other kinds than our layout files that say how structs lie in packets; packages read them.

An installed package names a ``Database`` as an entry point ``edoras.databases``. What it reads can stand
wherever a layout file can: ``--structs``, ``xtce``, ``wireshark``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from edoras_tools import doors

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.structs.shapes import StructLayout


@dataclass(frozen=True, slots=True)
class Database:
    """A kind of file with message layouts.

    Attributes:
        recognise: tells from a file's whole content whether it is of this kind; raises nothing.
        read: makes the layout of a content and the file's name; raises ``ConfigError`` with all mistakes.
    """

    recognise: Callable[[bytes], bool]
    read: Callable[[bytes, str], StructLayout]


def read_database(data: bytes, name: str) -> StructLayout | None:
    """Return the layout in a file of a kind that a package reads; None if it is of none.

    Raises:
        ConfigError: the file holds mistakes, or the package cannot be loaded.
    """
    for item in doors.installed("databases"):
        loaded = item.load()
        if not isinstance(loaded, Database):
            raise item.error(f"{item.place} is not an object of Database")
        if loaded.recognise(data):
            return loaded.read(data, name)
    return None
