"""XML as plain nodes that know their line: no document type, no entities but XML's own, no other file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NoReturn
from xml.parsers import expat

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

_DEEPEST: Final = 64
_MOST_NODES: Final = 1 << 18


class SheetError(Exception):
    """Something in a sheet that cannot be read; the sheet's other parts are."""


@dataclass(slots=True)
class Node:
    """An element.

    Attributes:
        tag: its name without a name space.
        attributes: as written.
        file: name of the file that it stands in.
        line: of the file, from 1.
        children: the elements in it.
    """

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    children: list[Node] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Its attribute ``name``; empty where it has none."""
        return self.attributes.get("name", "")

    @property
    def doc(self) -> str:
        """Its short description, on one line, without the marks of Doxygen."""
        words = self.attributes.get("shortDescription", "").split()
        return " ".join(word for word in words if word not in {"*", "\\brief"})

    def inside(self, *path: str) -> Iterator[Node]:
        """Yield the elements that tags lead to, one level each."""
        for item in self.children:
            if item.tag == path[0]:
                yield from item.inside(*path[1:]) if path[1:] else (item,)

    def walk(self) -> Iterator[Node]:
        """Yield the element and all in it."""
        yield self
        for item in self.children:
            yield from item.walk()

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


def parse_document(data: bytes, name: str) -> Node:
    """Return the root of a document.

    Raises:
        ConfigError: it is not XML, declares a document type, or is nested or as large as no data sheet is.
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    root = Node("", {}, name, 0)
    above = [root]
    count = 0

    def refuse(why: str) -> NoReturn:
        raise ConfigError(f"{name}:{parser.CurrentLineNumber}: {why}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(above) > _DEEPEST or count > _MOST_NODES:
            refuse(f"more than {_DEEPEST} levels or {_MOST_NODES:,} elements; that is no data sheet")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        node = Node(tag.rpartition(" ")[2], plain, name, parser.CurrentLineNumber)
        above[-1].children.append(node)
        above.append(node)

    def doctype(*_: Any) -> None:
        refuse("a document type (<!DOCTYPE ...>) is not read, for its entities may hold anything; remove it")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: above.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigError(f"{name}:{error.lineno}: is not XML: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # an encoding that Python has not
        raise ConfigError(f"{name}: is not XML: {error}") from error
    return root.children[0]
