"""The declarations in some space systems, by kind and path, and references between them."""

from __future__ import annotations

import posixpath
from collections import defaultdict
from contextlib import suppress
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.addons.databases.documents import Node, Notes, SheetError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


SYSTEM: Final = "SpaceSystem"
_MOST_MEMBERS: Final = 8
"""Maximum depth of members in a reference to a parameter."""
_SETS: Final = (
    (("TelemetryMetaData", "ParameterTypeSet"), "parameter type"),
    (("TelemetryMetaData", "ParameterSet"), "parameter"),
    (("TelemetryMetaData", "ContainerSet"), "container"),
    (("CommandMetaData", "ParameterTypeSet"), "parameter type"),
    (("CommandMetaData", "ParameterSet"), "parameter"),
    (("CommandMetaData", "ArgumentTypeSet"), "argument type"),
    (("CommandMetaData", "CommandContainerSet"), "container"),
    (("CommandMetaData", "MetaCommandSet"), "command"),
)
"""Path and kind of each set of declarations."""


class Declared(msgspec.Struct, frozen=True):
    """A declaration.

    Attributes:
        kind: kind, as ``parameter type``.
        path: name, behind the names of its space systems.
        node: element.
    """

    kind: str
    path: str
    node: Node

    @property
    def system(self) -> str:
        """Path of its space system."""
        return posixpath.dirname(self.path)


class Declarations:
    """All declarations in some space systems.

    Args:
        roots: elements of the outermost space systems; others may be inside.
        notes: notes, to which duplicate declarations are added.
    """

    def __init__(self, roots: Sequence[Node], notes: Notes) -> None:
        self._items: dict[tuple[str, str], Declared] = {}
        self._short: dict[tuple[str, str], list[Declared]] = defaultdict(list)
        for root in roots:
            for system, node in _systems(root, ""):
                for place, kind in _SETS:
                    for item in (child for holder in node.inside(*place) for child in holder.children):
                        if not item.name:
                            continue
                        entry = Declared(kind, f"{system}/{item.name}", item)
                        if self._items.setdefault((kind, entry.path), entry) is not entry:
                            notes.add(item, f"{kind} {entry.path} is declared twice; the first holds")
                        else:
                            self._short[kind, item.name].append(entry)

    def all(self, kind: str) -> Iterator[Declared]:
        """Yield the declarations of a kind."""
        return (item for (own, _), item in self._items.items() if own == kind)

    def find(self, kind: str, name: str, system: str) -> Declared:
        """Return the declaration that a name refers to in a space system, or in one of its parents.

        If several files are read, a system may belong into another one, which only the ground system's
        configuration
        says: then it is enough if the last part of the name is unique.

        Raises:
            SheetError: there is no declaration of that name.
        """
        name = name.strip()
        places = [""] if name.startswith("/") else [system, *map(str, PurePosixPath(system).parents)]
        for place in places:
            path = posixpath.normpath(f"/{place}/{name}")
            item = self._items.get((kind, "/" + path.lstrip("/")))
            if item is not None:
                return item
        alike = self._short.get((kind, posixpath.basename(name)), [])
        if len(alike) != 1:
            raise SheetError(f"{kind} {name} is in none of these files")
        return alike[0]

    def type_of(self, role: str, node: Node, system: str) -> Declared:
        """Return the type of a parameter or an argument; ``role`` is the kind."""
        return self.find(f"{role} type", node.required(f"{role}TypeRef"), system)

    def find_member(self, name: str, system: str) -> tuple[Declared, str]:
        """Return the parameter of a name, and the path of its member, ``/`` in front; empty for the whole.

        Raises:
            SheetError: there is no parameter of that name.
        """
        words = name.replace(".", "/").split("/") if not name.startswith(".") else name.split("/")
        for count in range(min(_MOST_MEMBERS, len(words))):
            whole = "/".join(words[: len(words) - count])
            with suppress(SheetError):
                return self.find("parameter", whole, system), "".join(
                    f"/{item}" for item in words[-count:] * bool(count)
                )
        raise SheetError(f"parameter {name} is in none of these files")


def _systems(node: Node, above: str) -> Iterator[tuple[str, Node]]:
    if node.tag == SYSTEM:
        path = f"{above}/{node.name}"
        yield path, node
        for item in node.children:
            yield from _systems(item, path)
