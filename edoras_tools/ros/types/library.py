"""Finds definitions: in folders, an MCAP's schemas, this package, a distribution or a sourced ROS 2.

Definitions are read on demand; only the folders that the user gave are listed at once.

The standard messages of every ROS 2 distribution, as rosbags knows them, are kept as text: rosbags builds a
class for each of them, which takes longer than any other step of a command's start. ``python
tests/ros/types/test_library.py`` writes the text again from the installed rosbags.
"""

from __future__ import annotations

import json
import os
import re
from ast import literal_eval
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import (
    PLACEHOLDER,
    TYPE_NAME,
    Constant,
    Definition,
    MessageField,
    Section,
    Shape,
    complete_text,
    full_name,
    parse_definition,
    sections,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rosbags.interfaces.typing import FieldDesc, Typesdict

_INCLUDE: Final = re.compile(r"^[ \t]*#.*", re.MULTILINE)
"""A line for the preprocessor; included types are found by their names instead."""
_IDL_PARTS: Final = re.compile(r"^=+\n(?:IDL: .*\n)?", re.MULTILINE)
"""Separator between the definitions of a schema."""
OWN: Final = Path(__file__).parent / "definitions"
"""The definitions of this package's own messages, ``PACKAGE/msg/NAME.msg``."""


class Library:
    """Finds definitions by type name; the first place that has one wins.

    Args:
        distro: ROS 2 distribution whose standard messages are known.
        msg_paths: folders (searched recursively) or files, laid out ``PACKAGE/msg/NAME.msg`` or ``.idl``.
        schemas: complete ``ros2msg`` texts by type, as an MCAP holds them.

    Raises:
        ConfigError: there is no such distribution or folder, or a folder holds no definition.
    """

    def __init__(
        self, distro: str, msg_paths: Iterable[str | os.PathLike[str]], schemas: Mapping[str, str]
    ) -> None:
        self.distro = distro
        self._release = _distro(distro)
        self._files = _index(msg_paths)
        self._sections: dict[str, tuple[str, Section]] = {}
        for name, text in schemas.items():
            for section in sections(full_name(name), text):
                self._sections.setdefault(section.name, (f"schema of {name}", section))
        self._found: dict[str, Definition] = {}

    def find(self, name: str) -> Definition | None:
        """Return the definition of a type; None if it is not found.

        Raises:
            ConfigError: the definition was found and has mistakes.
        """
        if name not in self._found and TYPE_NAME.fullmatch(name):
            by = self._from_files, self._from_schemas, self._from_package, self._from_distro, self._sourced
            if definition := next(filter(None, (find(name) for find in by)), None):
                self._found[name] = definition
        return self._found.get(name)

    def names(self) -> list[str]:
        """Return the names of all types in all places, sorted."""
        folders = [OWN, *_sourced_folders()]
        listed = {_type_of(file) for folder in folders for file in folder.glob("*/msg/*.msg")}
        return sorted(listed | self._files.keys() | self._sections.keys() | self._standard.keys())

    def _from_files(self, name: str) -> Definition | None:
        file = self._files.get(name)
        return _read(name, file) if file else None

    def _from_schemas(self, name: str) -> Definition | None:
        if name not in self._sections:
            return None
        label, section = self._sections[name]
        return parse_definition(name, section.text, label, section.line)

    def _from_package(self, name: str) -> Definition | None:
        return _read_if_there(name, OWN)

    def _from_distro(self, name: str) -> Definition | None:
        text = self._standard.get(name)
        return None if text is None else parse_definition(name, text, f"{name} of {self._release}")

    def _sourced(self, name: str) -> Definition | None:
        return next(filter(None, (_read_if_there(name, folder) for folder in _sourced_folders())), None)

    @cached_property
    def _standard(self) -> dict[str, str]:
        return standard(self._release)


def _read_if_there(name: str, folder: Path) -> Definition | None:
    """Read a type's definition from a folder of packages; None if the folder does not have it."""
    file = folder / f"{name}.msg"
    try:
        exists = file.is_file()
    except OSError:  # the name is longer than a file name may be
        return None
    return _read(name, file) if exists else None


def _distro(distro: str) -> str:
    """Return the distribution of a name, which may be ``latest`` or ``rolling``."""
    names = distros()
    if distro in {"latest", "rolling"}:
        return names[-1]
    if distro not in names:
        raise ConfigError(
            f"distro {distro!r} is not a ROS 2 distribution; known: {', '.join(names)}, latest, rolling"
        )
    return distro


def _index(paths: Iterable[str | os.PathLike[str]]) -> dict[str, Path]:
    """Return the definition files of folders by type name; the first file of a name wins."""
    index: dict[str, Path] = {}
    mistakes = []
    for folder in map(Path, paths):
        path = folder.absolute()
        if not path.exists():
            mistakes.append(f"msg-path {folder}: no such file or folder")
            continue
        candidates = (
            [path] if path.is_file() else [*sorted(path.rglob("*.msg")), *sorted(path.rglob("*.idl"))]
        )
        entries = {
            _type_of(file): file
            for file in reversed(candidates)
            if file.parent.name in {"msg", "srv", "action"}
        }
        if not entries:
            mistakes.append(
                f"msg-path {folder}: no definition there; expected PACKAGE/msg/NAME.msg or NAME.idl"
            )
        index = entries | index
    if mistakes:
        raise ConfigError(*mistakes)
    return index


def _type_of(file: Path) -> str:
    return f"{file.parent.parent.name}/{file.parent.name}/{file.stem}"


def _sourced_folders() -> Iterator[Path]:
    """Yield the ``share`` folder of every prefix of a sourced ROS 2."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix, "share")


def _read(name: str, file: Path) -> Definition:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{file}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8'}"
        ) from error
    return parse_definition(name, text, str(file)) if file.suffix == ".msg" else _read_idl(name, text, file)


def _read_idl(name: str, text: str, file: Path) -> Definition:
    types = _idl_types(text, str(file))
    if name not in types:
        raise ConfigError(f"{file}:1: defines {', '.join(types) or 'no type'}, not {name}")
    return converted(name, types)


def _idl_types(text: str, place: str) -> Typesdict:
    from rosbags.typesys import TypesysError, get_types_from_idl

    try:
        return get_types_from_idl(_INCLUDE.sub("", text))
    except (
        TypesysError,
        ValueError,
        KeyError,
        RecursionError,
        AssertionError,
        TypeError,
        AttributeError,
    ) as error:
        raise ConfigError(f"{place}:{_idl_line(error)}: not the IDL that ROS 2 writes") from error


def text_of_idl(name: str, text: str) -> str:
    """Return the ``ros2msg`` text of a type's ``ros2idl`` schema, complete with the types that it uses.

    Raises:
        ConfigError: the text is not the IDL that ROS 2 writes.
    """
    by_name: dict[str, Definition] = {}
    for part in _IDL_PARTS.split(text):
        if part.strip():
            types = _idl_types(part, f"schema of {name}")
            by_name.update((item, converted(item, types)) for item in types)
    if full_name(name) not in by_name:
        raise ConfigError(f"schema of {name}: defines {', '.join(by_name) or 'no type'}")
    head = by_name.pop(full_name(name))
    return complete_text([head, *by_name.values()]) or "\n"  # an empty message has a definition, too


def _idl_line(error: Exception) -> int:
    """Return the line where rosbags' parser stopped: its message holds the text, then the position."""
    parts = str(error).split("\n")
    try:
        return str(literal_eval(parts[1])).count("\n", 0, int(parts[2])) + 1
    except (IndexError, ValueError, SyntaxError):
        return 1


FILE: Final = Path(__file__).parent / "definitions" / "standard.json"
"""File with ``distros``, oldest first, and ``types``: name -> {distribution: ``ros2msg`` text}. A text
applies until a newer distribution has another one; null ends it."""
_STANDARD_DEFAULTS: Final = {
    ("geometry_msgs/msg/Quaternion", "w"): (1.0, ""),
    ("sensor_msgs/msg/NavSatStatus", "status"): (-2, "STATUS_UNKNOWN"),
}
"""Defaults that are not zero, since rosbags keeps none, for the standard packages: (type, field) to (value,
constant). Each applies only if the definition has the constant, if one is named."""


def distros() -> list[str]:
    """Return the names of the distributions, oldest first."""
    return list(_table()["distros"])


def standard(distro: str) -> dict[str, str]:
    """Return the definitions of a distribution, ``ros2msg`` text by type name.

    Raises:
        ValueError: there is no such distribution.
    """
    table = _table()
    until = table["distros"].index(distro) + 1
    texts_by_name = {}
    for name, texts in table["types"].items():
        for distro_ in table["distros"][:until]:
            if distro_ in texts:
                texts_by_name[name] = texts[distro_]
    return {name: text for name, text in texts_by_name.items() if text is not None}


@cache
def _table() -> dict[str, Any]:
    return json.loads(FILE.read_text(encoding="utf-8"))


def converted(name: str, types: Typesdict) -> Definition:
    """Return a definition that rosbags holds as one of ours."""
    constants, fields = types[name]
    constants_named = {"", *(item for item, _, _ in constants)}
    defaults = {
        field: value
        for (owner, field), (value, constant) in _STANDARD_DEFAULTS.items()
        if owner == name and constant in constants_named
    }
    return Definition(
        name,
        tuple(_field(item, description, defaults) for item, description in fields if item != PLACEHOLDER),
        tuple(Constant(item, kind, value) for item, kind, value in constants),
    )


def _field(name: str, description: FieldDesc, defaults: dict[str, Any]) -> MessageField:
    """Convert rosbags' description of a field, nested pairs of a node kind and its arguments, to ours."""
    from rosbags.interfaces import Nodetype

    kind: Any
    arguments: Any
    kind, arguments = description
    shape, size = Shape.SCALAR, 0
    if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        shape = Shape.ARRAY if kind == Nodetype.ARRAY else Shape.SEQUENCE
        (kind, arguments), size = arguments
    base, bound = arguments if kind == Nodetype.BASE else (arguments, 0)
    return MessageField(name, base, bound, shape, size, defaults.get(name))
