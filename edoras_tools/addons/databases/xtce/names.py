"""What stands in some space systems, by kind and path, and how one thing names another."""

from __future__ import annotations

import posixpath
from collections import defaultdict
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.databases.documents import Node, Notes, SheetError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


SYSTEM: Final = "SpaceSystem"
_MOST_MEMBERS: Final = 8
"""Declarations behind that of a parameter, of the members in each other."""
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
"""Where each kind of thing is declared."""


class Declared(msgspec.Struct, frozen=True):
    """Something that is declared.

    Attributes:
        kind: what it is, as ``parameter type``.
        path: its name, behind those of the space systems that it is in.
        node: its element.
    """

    kind: str
    path: str
    node: Node

    @property
    def system(self) -> str:
        """The path of the space system that it is in."""
        return posixpath.dirname(self.path)

    def replaced(self, node: Node) -> Declared:
        """Return it with another element."""
        return replace(self, node=node)


class Declarations:
    """Everything that is declared in some space systems.

    Args:
        roots: the elements of the outermost; others may stand in them.
        notes: what is declared twice.
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
        """Yield what is of a kind."""
        return (item for (own, _), item in self._items.items() if own == kind)

    def find(self, kind: str, name: str, system: str) -> Declared:
        """Return what a name means in a space system, or in one that it is in.

        Where several files are read, a system may be meant to be in another one, which only the ground
        system's configuration says: then a last name that is there once is enough.

        Raises:
            SheetError: nothing has the name.
        """
        name = name.strip()
        places = [""] if name.startswith("/") else [system, *_above(system)]
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
        """Return the type of a parameter or an argument, as ``role`` says."""
        return self.find(f"{role} type", node.required(f"{role}TypeRef"), system)

    def find_member(self, name: str, system: str) -> tuple[Declared, str]:
        """Return the parameter that a name means, and behind ``/`` the member of it; nothing: the whole.

        Raises:
            SheetError: nothing has the name.
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


def _above(system: str) -> Iterator[str]:
    while system.strip("/"):
        system = posixpath.dirname(system)
        yield system
