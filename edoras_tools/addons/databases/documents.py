"""XML as plain nodes with their line: no document type, no entities except XML's own, no other file."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NoReturn
from xml.parsers import expat

import msgspec

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Container, Iterator

NESTING: Final = 64
"""Most elements that contain each other, types too, and most bases of one."""
_MOST_NODES: Final = 1 << 18
_SEARCHED: Final = 1 << 16
_LONGEST_TEXT: Final = 200
"""Maximum number of kept characters of an element's text: more than any unit or number has."""


class SheetError(Exception):
    """Error: a part of a file cannot be read; the other parts are."""


class Node(msgspec.Struct):
    """An element.

    Attributes:
        tag: name without a name space.
        attributes: attributes as written.
        file: name of its file.
        line: line in the file, from 1.
        children: child elements.
        text: text, without that of its children.
    """

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    children: list[Node] = msgspec.field(default_factory=list)
    text: str = ""

    @property
    def name(self) -> str:
        """Attribute ``name``; empty if it has none."""
        return self.attributes.get("name", "")

    @property
    def doc(self) -> str:
        """Short description, on one line, without Doxygen's marks."""
        words = self.attributes.get("shortDescription", "").split()
        return " ".join(word for word in words if word not in {"*", "\\brief"})

    def inside(self, *path: str) -> Iterator[Node]:
        """Yield the elements on a path of tags, one level each."""
        for item in self.children:
            if item.tag == path[0]:
                yield from item.inside(*path[1:]) if path[1:] else (item,)

    def walk(self) -> Iterator[Node]:
        """Yield the element and all its descendants."""
        yield self
        for item in self.children:
            yield from item.walk()

    def required(self, key: str) -> str:
        """Return an attribute.

        Raises:
            SheetError: the attribute is missing.
        """
        if key not in self.attributes:
            raise SheetError(f"{self.tag} {self.name}".rstrip() + f" has no {key}")
        return self.attributes[key]

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


class Notes(dict[str, Node]):
    """Notes on parts of the files that are not read, each with the first such element."""

    def add(self, node: Node, text: str) -> None:
        """Add a note, once."""
        self.setdefault(text, node)

    def unread(self, node: Node, read: Container[str], quiet: Container[str]) -> None:
        """Note the kinds of elements that are not read, each once.

        Args:
            read: tags that are read.
            quiet: tags that are not about packets, or that have their own notes; their descendants are
                skipped too.
        """
        if node.tag in quiet:
            return
        if node.tag not in read:
            self.add(node, f"{node.tag} is not read")
            return
        for item in node.children:
            self.unread(item, read, quiet)

    def lines(self) -> tuple[str, ...]:
        """Return one line for each note, with file and line."""
        return tuple(f"{node}: {text}" for text, node in self.items())


def has_root(data: bytes, *tags: str) -> bool:
    """Return whether a file is XML and begins with an element of one of these tags, in any name space."""
    root = rb"<(?:[\w.-]+:)?(?:%s)[\s>/]" % "|".join(tags).encode()
    is_xml = data[:4].lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<")
    return is_xml and re.search(root, data[:_SEARCHED]) is not None


def parse_document(data: bytes, name: str) -> Node:
    """Return the root of a document.

    Raises:
        ConfigError: it is not XML, has a document type, or is too deep or too large for a description of
        packets.
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
        if len(above) > NESTING or count > _MOST_NODES:
            refuse(f"more than {NESTING} levels or {_MOST_NODES:,} elements; that describes no packets")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        node = Node(tag.rpartition(" ")[2], plain, name, parser.CurrentLineNumber)
        above[-1].children.append(node)
        above.append(node)

    def doctype(*_: Any) -> None:
        refuse("a document type (<!DOCTYPE ...>) is not read, for its entities may hold anything; remove it")

    def characters(text: str) -> None:
        above[-1].text = (above[-1].text + text)[:_LONGEST_TEXT]

    parser.StartElementHandler = start
    parser.CharacterDataHandler = characters
    parser.EndElementHandler = lambda _: above.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigError(f"{name}:{error.lineno}: is not XML: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # an encoding that Python does not have
        raise ConfigError(f"{name}: is not XML: {error}") from error
    return root.children[0]
