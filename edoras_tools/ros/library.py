"""ROS message definitions: values, their ``ros2msg`` text, the reader of such text, and where they are found.

They are found in folders, an MCAP's schemas, this package, a distribution or a sourced ROS 2. Definitions are
read on demand; only the folders that the user gave are listed at once.

The standard messages of every ROS 2 distribution, as rosbags knows them, are kept as text: rosbags builds a
class for each of them, which takes longer than any other step of a command's start. ``python
tests/ros/test_library.py`` writes the text again from the installed rosbags.

``.msg`` text is read as rosidl does (ROS 2 interface definition): one definition, or several joined. Each
mistake is a ``ConfigError`` of one line, ``FILE:LINE: what is wrong``.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
from ast import literal_eval
from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import Enum
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

import msgspec

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

PRIMITIVES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""``struct`` codes of the fixed-size ROS types; ROS 2's ``byte`` and ``char`` are both unsigned."""
STRINGS: Final = frozenset({"string", "wstring"})
PLACEHOLDER: Final = "structure_needs_at_least_one_member"
"""Name of the one byte that an empty message has on the wire; definitions and values do not have it."""
SEPARATOR: Final = "=" * 80
"""The line between the definitions of a complete ``ros2msg`` text."""

TYPE_NAME: Final = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)


class Shape(Enum):
    """The number of values in a field: one, fixed, or counted."""

    SCALAR = "scalar"
    ARRAY = "array"
    SEQUENCE = "sequence"


class MessageField(msgspec.Struct, frozen=True):
    """One field of a message.

    Attributes:
        name: name as written.
        type: a name of ``PRIMITIVES`` or ``STRINGS``, or the full name of a message type.
        string_bound: most characters of a string; 0 for no limit.
        shape: one value, a fixed number of values, or a counted sequence.
        size: elements of an array, or most elements of a sequence, 0 for no limit.
        default: value if none is given; None for zero.
    """

    name: str
    type: str
    string_bound: int = 0
    shape: Shape = Shape.SCALAR
    size: int = 0
    default: Any = None

    @property
    def type_text(self) -> str:
        """The type as a ``.msg`` file spells it."""
        bound = f"<={self.string_bound}" if self.string_bound else ""
        limit = "<=" if self.size and self.shape is Shape.SEQUENCE else ""
        count = "" if self.shape is Shape.SCALAR else f"[{limit}{self.size or ''}]"
        return short_name(self.type) + bound + count


class Constant(msgspec.Struct, frozen=True):
    """A named value of a message definition; it is not sent."""

    name: str
    type: str
    value: Any


class Definition(msgspec.Struct, frozen=True):
    """One message definition.

    Attributes:
        name: full type name, as ``geometry_msgs/msg/Twist``.
        fields: fields in wire order; none for an empty message.
        constants: constants in the order of the file.
    """

    name: str
    fields: tuple[MessageField, ...]
    constants: tuple[Constant, ...] = ()

    @property
    def text(self) -> str:
        """The definition as ``ros2msg`` text, without the types that it uses."""
        lines = [f"{item.type} {item.name}={_literal(item.value)}" for item in self.constants]
        for item in self.fields:
            default = "" if item.default is None else _literal(item.default)
            lines.append(f"{item.type_text} {item.name}" + (f" {default}" if default else ""))
        return "".join(line + "\n" for line in lines)


def full_name(name: str) -> str:
    """Return ``pkg/msg/Name`` for ``pkg/Name``; any other name unchanged."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def short_name(name: str) -> str:
    """Return ``pkg/Name`` for ``pkg/msg/Name``, as definitions refer to it; any other name unchanged."""
    return name.replace("/msg/", "/")


def with_used(name: str, find: Callable[[str], Definition]) -> tuple[Definition, ...]:
    """Return a type's definition, then the definitions of all types that it uses, each once."""
    by_name: dict[str, Definition] = {}

    def collect(name: str) -> None:
        if name not in by_name:
            by_name[name] = find(name)
            for item in by_name[name].fields:
                if "/" in item.type:
                    collect(item.type)

    collect(name)
    return tuple(by_name.values())


def complete_text(definitions: Iterable[Definition]) -> str:
    """Return a definition and those that it uses as one ``ros2msg`` text, in the form of an MCAP schema.

    Args:
        definitions: the message itself, then every type that it uses, each once.
    """
    head, *rest = definitions
    return head.text + "".join(f"{SEPARATOR}\nMSG: {short_name(item.name)}\n{item.text}" for item in rest)


def _literal(value: Any) -> str:
    """Return a constant or default as ``.msg`` text; empty if the format cannot express it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        quote = "'" if '"' in value and "'" not in value else '"'
        return quote + value.replace("\\", "\\\\").replace(quote, "\\" + quote) + quote
    if isinstance(value, list):
        items = [_literal(item) for item in value]
        return f"[{', '.join(items)}]" if items and all(items) else ""
    return repr(value) if isinstance(value, int) or math.isfinite(value) else ""


_CODE: Final = re.compile(r"""(?:[^#"']|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|["'])*?(?=#|$)""")
"""A line up to its comment; a ``#`` inside quotes does not start one."""
_TYPE: Final = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<bound>\d+))?(?P<array>\[(?P<limit><=)?(?P<size>\d*)\])?", re.ASCII
)
_NAME: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)
_CONSTANT: Final = re.compile(r"([A-Za-z]\w*)\s*=\s*(.*)", re.ASCII)
_STRING: Final = re.compile(r""""((?:\\.|[^"\\])*)"|'((?:\\.|[^'\\])*)'""")
_ITEM: Final = re.compile(r"""\s*("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[^,"']+?)\s*(?:,|$)""")
_SECTION: Final = re.compile(r"={3,}\s*\nMSG:[ \t]*(\S+)[ \t]*\n?")
_TRUTH: Final = {"true": True, "1": True, "false": False, "0": False}
_MOST: Final = 2**32 - 1


class Section(NamedTuple):
    """One definition of a joined text: full type name, text, and line number where the text starts."""

    name: str
    text: str
    line: int


def sections(name: str, text: str) -> Iterator[Section]:
    """Yield the definitions of a complete ``ros2msg`` text, split at its ``===`` lines, the message first."""
    text = text.replace("\r\n", "\n")
    start, line = 0, 1
    for match in _SECTION.finditer(text):
        yield Section(full_name(name), text[start : match.start()], line)
        line += text.count("\n", start, match.end())
        start, name = match.end(), match[1]
    yield Section(full_name(name), text[start:], line)


@lru_cache(2048)  # several stores read the same definitions of a distribution
def parse_definition(name: str, text: str, file: str, first_line: int = 1) -> Definition:
    """Read one message definition.

    Args:
        name: full type name.
        text: the ``.msg`` text.
        file: name of the file in error messages.
        first_line: number of the text's first line in ``file``.

    Raises:
        ConfigError: every mistake of the text, a line each.
    """
    fields: dict[str, MessageField] = {}
    constants: dict[str, Constant] = {}
    mistakes = []
    for number, raw in enumerate(text.splitlines(), first_line):
        match = _CODE.match(raw)
        code = (match[0] if match else raw).strip()
        if not code:
            continue
        try:
            item = _line(name, code)
            members: dict[str, Any] = fields if isinstance(item, MessageField) else constants
            if item.name in members:
                _refuse(f"{item.name}: the name is taken already")
            members[item.name] = item
        except ValueError as error:
            mistakes.append(f"{file}:{number}: {error}")
    if mistakes:
        raise ConfigError(*mistakes)
    return Definition(name, tuple(fields.values()), tuple(constants.values()))


def _refuse(why: str) -> NoReturn:
    raise ValueError(why)


def _line(owner: str, code: str) -> MessageField | Constant:
    type_text, _, rest = code.partition(" ") if "\t" not in code else code.replace("\t", " ").partition(" ")
    rest = rest.strip()
    match = _TYPE.fullmatch(type_text)
    if match is None or not rest:
        _refuse(f"{code!r} is not a field; write TYPE NAME, TYPE NAME DEFAULT or TYPE NAME=VALUE")
    base, bound = match["base"], int(match["bound"] or 0)
    if constant := _CONSTANT.fullmatch(rest):
        if match["array"] or match["bound"] or base not in PRIMITIVES.keys() | STRINGS:
            _refuse(f"{constant[1]}: a constant is of a primitive type, not {type_text}")
        return Constant(constant[1], base, _value(base, constant[2], constant[1]))

    field_name, _, default = rest.partition(" ")
    if not _NAME.fullmatch(field_name):
        _refuse(f"{field_name!r} is not a field name; letters, digits and _ only")
    if base not in PRIMITIVES and base not in STRINGS:
        base = full_name(base) if "/" in base else f"{owner.rpartition('/')[0]}/{base}"
        if not TYPE_NAME.fullmatch(base):
            _refuse(f"{field_name}: {match['base']!r} is not a type name; write PACKAGE/NAME")
    if match["bound"] is not None and (base not in STRINGS or bound == 0):
        _refuse(f"{field_name}: only a string takes a bound, of at least 1, not {type_text}")
    shape, size = _shape(match, field_name)
    default = default.strip()
    value = None
    if default:
        if base not in PRIMITIVES and base not in STRINGS:
            _refuse(f"{field_name}: a field of a message type takes no default")
        value = (
            _value(base, default, field_name) if shape is Shape.SCALAR else _values(base, default, field_name)
        )
        if shape is Shape.ARRAY and len(value) != size:
            _refuse(f"{field_name}: the default holds {len(value)} values, {size} are declared")
    return MessageField(field_name, base, bound, shape, size, value)


def _shape(match: re.Match[str], name: str) -> tuple[Shape, int]:
    if not match["array"]:
        return Shape.SCALAR, 0
    if not match["size"] and not match["limit"]:
        return Shape.SEQUENCE, 0
    size = int(match["size"] or 0)
    if not 0 < size <= _MOST:
        _refuse(f"{name}: an array holds 1 to {_MOST} elements, not {match['array']}")
    return (Shape.SEQUENCE if match["limit"] else Shape.ARRAY), size


def _values(base: str, text: str, name: str) -> list[Any]:
    if not (text.startswith("[") and text.endswith("]")):
        _refuse(f"{name}: the default of an array is [a, b, c], not {text}")
    inner, position, values = text[1:-1].strip(), 0, []
    while position < len(inner):
        match = _ITEM.match(inner, position)
        if match is None:
            _refuse(f"{name}: {text} is not a list of {base}")
        values.append(_value(base, match[1], name))
        position = match.end()
    return values


def _value(base: str, text: str, name: str) -> Any:
    """Read a constant or a default, checked against its type."""
    if base in STRINGS:
        match = _STRING.fullmatch(text)
        if match is None:
            return text
        return re.sub(r"\\(.)", r"\1", match[1] if match[1] is not None else match[2])
    try:
        if base == "bool":
            return _TRUTH[text.lower()]
        value = float(text) if base.startswith("float") else _integer(text)
        struct.pack("<" + PRIMITIVES[base], value)
    except (KeyError, ValueError, OverflowError, struct.error):
        _refuse(f"{name}: {text!r} is not a valid {base}")
    return value


def _integer(text: str) -> int:
    digits = text.lstrip("+-")
    return int(text, 0 if digits[:2].lower() in {"0x", "0b", "0o"} else 10)


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
            own, sourced = partial(_read_if_there, folder=OWN), self._sourced
            by = self._from_files, self._from_schemas, own, self._from_distro, sourced
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
