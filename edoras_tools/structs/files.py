"""Reads and writes layout files (structs and their packets, as YAML or JSON); the layout of cFE itself.

``cfe.json`` beside this file has what cFE's core services and the usual applications send and take, so that
it decodes without an ELF file. Each struct describes the bytes after the packet's header. Numbers are
little-endian; the order and widths of telemetry members were measured on a flight. Names follow this
package's words, not cFE's. Events and the counters of the software bus come from the tables of
:mod:`edoras_tools.wire.cfe`, with which the sessions write them; commands come from the table of their
arguments, :mod:`edoras_tools.cfs.arguments`.
"""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

from msgspec.structs import replace

from edoras_tools import doors
from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, SERVICES, TAILS
from edoras_tools.errors import ConfigError
from edoras_tools.structs import shapes
from edoras_tools.wire import cfe
from edoras_tools.wire import layout as wire
from edoras_tools.wire.ccsds import VERSION_1, VERSION_2, MsgIds

if TYPE_CHECKING:
    import os

LAYOUT_VERSION: Final = 1
LAYOUT_FILE: Final = "structs.yaml"
"""Name of the layout file in a folder that 'edoras structs' wrote."""
_LARGEST: Final = 1 << 24
_TYPE: Final = re.compile(
    r"(?P<name>[A-Za-z_]\w*)(?P<dims>(?:\[\w*\])*)(?::(?P<bits>\d+))?(?P<hex>\s+hex)?(?:\s+(?P<order>big|little))?"
    r"(?:\s*@\s*(?P<offset>\w+)(?:\.(?P<bit>\d+))?)?",
    re.ASCII,
)
_DIMENSION: Final = re.compile(r"\[(\w*)\]")
_TOP: Final = {"edoras_structs", "byte_order", "package", "bind", "enums", "structs"}
_STRUCT: Final = {"size", "header", "union", "packed", "members", "doc", "tail"}
_ABOUT: Final = ("doc", "unit", "polynomial", "yellow", "red")
_NUMBERS: Final = {int, float}
_FINITE: Final = 1e300
_PACKAGE: Final = re.compile(r"[a-z](?:_?[a-z0-9])*", re.ASCII)
_IN_C: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_SECONDARY_HEADER: Final = 0x0800
_HIGHEST: Final = 0x1FFF
"""Highest MsgId; tables by MsgId keep row 0xFFFF for rows without a packet (-1)."""


class Database(NamedTuple):
    """A kind of file with message layouts, which an add-on or a package reads (``edoras.databases``).

    Such a file can be used in place of a layout file: ``--set structs``, ``xtce``, ``wireshark``.

    Attributes:
        recognise: returns whether a file is of this kind, from its whole content; raises nothing.
        read: makes a layout from the content and the name of a file; raises ``ConfigError`` with all
            mistakes.
        read_together: makes one layout from several files and options like those of a compiler; None if a
            layout of this kind is always one file.
    """

    recognise: Callable[[bytes], bool]
    read: Callable[[bytes, str], shapes.StructLayout]
    read_together: Callable[[Sequence[tuple[bytes, str]], Sequence[str]], shapes.StructLayout] | None = None


def load_layout(path: str | os.PathLike[str]) -> shapes.StructLayout:
    """Read a layout file; for a folder, read the ``structs.yaml`` in it.

    Raises:
        ConfigError: the file cannot be read, or has mistakes: all of them, a line each.
    """
    file, data = read_layout(path)
    return parse_layout(data, str(file))


def load_together(paths: Sequence[Path], flags: Sequence[str] = ()) -> shapes.StructLayout:
    """Read files that make one layout together; a single file may be any layout file.

    Args:
        flags: options like those of a compiler, for the kind of the files.

    Raises:
        ConfigError: a file cannot be read or has mistakes, or several files are of a kind that is one file.
    """
    files = [(data, str(file)) for file, data in map(read_layout, paths)]
    database = _database(files[0][0])
    if database is not None and database.read_together is not None:
        return database.read_together(files, flags)
    if len(files) > 1:
        raise ConfigError(f"{files[1][1]}: a second file, which only data sheets have; name one")
    return parse_layout(*files[0])


def read_layout(path: str | os.PathLike[str]) -> tuple[Path, bytes]:
    """Return the layout file of a path, and its content.

    Raises:
        ConfigError: the file cannot be read, or is a program.
    """
    file = Path(path)
    file = file / LAYOUT_FILE if file.is_dir() else file
    try:
        with file.open("rb") as stream:
            data = stream.read(_LARGEST + 1)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read ({error.strerror}); give a layout file") from error
    if data.startswith(b"\x7fELF"):
        raise ConfigError(
            f"{file}: a program, not a layout; 'edoras structs {file} -o DIR' makes a layout of it"
        )
    return file, data


def parse_layout(data: bytes, name: str) -> shapes.StructLayout:
    """Read a layout from memory.

    Raises:
        ConfigError: the layout has mistakes: all of them, a line each.
    """
    if len(data) > _LARGEST:
        raise ConfigError(f"{name}: larger than {_LARGEST >> 20} MiB; that is not a layout file")
    database = _database(data)
    return layout_of(plain_values(data, name), name) if database is None else database.read(data, name)


def _database(data: bytes) -> Database | None:
    """Return the add-on's or package's ``Database`` that recognises a file; None if none does.

    Raises:
        ConfigError: a package cannot be loaded.
    """
    ships = [item for item in doors.shipped("databases").values() if not item.absent]
    for item in (*ships, *doors.installed("databases")):
        loaded = item.load()
        if not isinstance(loaded, Database):
            raise item.error(f"{item.place} is not an object of Database")
        if loaded.recognise(data):
            return loaded
    return None


def layout_of(raw: Any, name: str) -> shapes.StructLayout:
    """Read a layout from the plain values of a layout file; see :func:`parse_layout`."""
    return _Reader(name).layout(raw)


def plain_values(data: bytes, name: str) -> Any:
    """Return the values of a file of YAML or JSON.

    Raises:
        ConfigError: the file is neither, or an object of JSON has a key twice.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        text = data.decode()
        if text.lstrip().startswith("{"):
            return json.loads(text, object_pairs_hook=_once)
        return YAML(typ="safe", pure=True).load(text)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{name}:{error.lineno}: is not JSON: {error.msg}") from error
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ConfigError(f"{name}:{line}: is not YAML: {error.problem or error.context}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{name}: no layout file: it is not text") from error
    except (YAMLError, ValueError, RecursionError) as error:
        reason = str(error).partition("\n")[0]
        raise ConfigError(f"{name}: is not YAML: {reason or type(error).__name__}") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object from its pairs; a repeated key is an error."""
    pairs_read: dict[str, Any] = {}
    for key, value in pairs:
        if key in pairs_read:
            raise ValueError(f"{_printed(key)} is there twice")
        pairs_read[key] = value
    return pairs_read


def _printed(raw: Any) -> str:
    """Return a value as short text for messages."""
    return _SHORT.repr(raw)


class _Reader:
    """Turns the plain values of a file into a layout, and collects its mistakes."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._mistakes: list[str] = []
        self._raw: Mapping[str, Any] = {}
        self._enums: dict[str, shapes.Enumeration] = {}
        self._structs: dict[str, shapes.Struct] = {}
        self._alignments: dict[str, int] = {}
        self._open: list[str] = []

    def layout(self, raw: Any) -> shapes.StructLayout:
        if not isinstance(raw, dict) or "structs" not in raw:
            raise ConfigError(
                f"{self._name}: no layout file: it has no 'structs'; 'edoras structs -o DIR' writes one"
            )
        self._check_keys("", raw, _TOP)
        if raw.get("edoras_structs", LAYOUT_VERSION) != LAYOUT_VERSION:
            version = _printed(raw["edoras_structs"])
            raise ConfigError(
                f"{self._name}: edoras_structs {version} is not known; this version reads {LAYOUT_VERSION}"
            )
        order: shapes.ByteOrder = "little"
        if raw.get("byte_order", "little") not in ("little", "big"):
            self._mistake("byte_order", f"{_printed(raw['byte_order'])} is neither little nor big")
        elif "byte_order" in raw:
            order = raw["byte_order"]
        package = raw.get("package", "cfs_msgs")
        if not isinstance(package, str) or not is_package(package):
            self._mistake("package", f"{_printed(package)} is not a name of a ROS package, as rover_msgs")
        for name, item in self._mapping("enums", raw.get("enums", {})):
            self._enum(name, item)
        self._raw = dict(self._mapping("structs", raw["structs"]))
        for name in self._raw:
            if name in shapes.BASIC or name in self._enums:
                self._mistake(f"structs.{name}", "another type has this name")
            self._struct(name, f"structs.{name}")
        bindings: dict[shapes.Key, str] = {}
        for text, name in self._mapping("bind", raw.get("bind", {})):
            try:
                key = parse_key(text)
            except ConfigError as error:
                self._mistake("bind", str(error))
                continue
            if key in bindings:
                self._mistake(f"bind.{key}", "it is bound twice")
            if not isinstance(name, str) or name not in self._structs:
                self._mistake(f"bind.{key}", f"there is no struct {_printed(name)}")
            bindings[key] = str(name) if isinstance(name, str) else ""
        if self._mistakes:
            raise ConfigError(*dict.fromkeys(self._mistakes))
        return shapes.StructLayout(self._structs, self._enums, bindings, order, package, self._name)

    def _mistake(self, where: str, text: str) -> None:
        self._mistakes.append(f"{self._name}: {where + ': ' if where else ''}{text}")

    def _check_keys(self, where: str, raw: Mapping[Any, Any], keys: set[str]) -> None:
        for key in raw:
            if key not in keys:
                allowed = ", ".join(sorted(keys))
                self._mistake(where, f"{_printed(key)} means nothing here; there are {allowed}")

    def _mapping(self, where: str, raw: Any) -> Iterator[tuple[Any, Any]]:
        if not isinstance(raw, dict):
            self._mistake(where, "expected NAME: VALUE")
            return
        for key, value in raw.items():
            if where != "bind" and (not isinstance(key, str) or not _IN_C.fullmatch(key)):
                self._mistake(where, f"{_printed(key)} is not a name in C")
            else:
                yield key, value

    def _number(self, where: str, raw: Any, most: int = _LARGEST) -> int | None:
        if isinstance(raw, bool) or not isinstance(raw, int) or not 0 <= raw <= most:
            self._mistake(where, f"{_printed(raw)} is not a number of 0 to {most}")
            return None
        return raw

    def _flag(self, where: str, raw: Mapping[str, Any], name: str) -> bool:
        if raw.get(name, False) not in (False, True):
            self._mistake(where, f"{name}: {_printed(raw[name])} is neither true nor false")
        return raw.get(name) is True

    def _doc(self, where: str, raw: Mapping[str, Any], key: str = "doc") -> str:
        """Return the documentation of an item, on one line: it becomes a comment."""
        if not isinstance(raw.get(key, ""), str):
            self._mistake(where, f"{key}: {_printed(raw[key])} is not text")
            return ""
        return " ".join(raw.get(key, "").split())

    def _about(self, where: str, raw: Mapping[str, Any]) -> dict[str, Any]:
        """Return the description of a member's value: documentation, unit, calibration and limits."""
        self._check_keys(where, raw, {"type", *_ABOUT})
        about: dict[str, Any] = {key: self._doc(where, raw, key) for key in ("doc", "unit")}
        for key in raw.keys() & set(_ABOUT[2:]):
            values, form = raw[key], "[LOW, HIGH], null for no end"
            fits = isinstance(values, list) and len(values) == 2
            if key == "polynomial":
                form, fits = "a list of numbers", isinstance(values, list) and None not in values
            if fits and all(
                item is None or (type(item) in _NUMBERS and abs(item) < _FINITE) for item in values
            ):
                about[key] = tuple(values)
            else:
                self._mistake(where, f"{key}: {_printed(values)} is not {form}")
        return about

    def _enum(self, name: str, raw: Any) -> None:
        where = f"enums.{name}"
        if not isinstance(raw, dict):
            self._mistake(where, "expected {type: ..., values: {NAME: NUMBER}}")
            return
        self._check_keys(where, raw, {"type", "values"})
        basic = shapes.BASIC.get(kind) if isinstance(kind := raw.get("type", "int32"), str) else None
        if basic is None or basic.kind not in {shapes.BasicKind.INT, shapes.BasicKind.UINT}:
            self._mistake(where, f"{_printed(raw.get('type'))} is not an integer, as int32 or uint8")
            basic = shapes.BASIC["int32"]
        if name in shapes.BASIC:
            self._mistake(where, "another type has this name")
        names: dict[int, str] = {}
        for label, value in self._mapping(f"{where}.values", raw.get("values", {})):
            if isinstance(value, bool) or not isinstance(value, int):
                self._mistake(where, f"{label}: {_printed(value)} is not a number")
            elif not basic.holds(value):
                self._mistake(where, f"{label}: {_printed(value)} does not fit {basic}")
            else:
                names.setdefault(value, label)
        self._enums[name] = shapes.Enumeration(name, basic, names)

    def _struct(self, name: str, where: str) -> None:
        """Read a struct, after the structs that it uses."""
        if name in self._structs:
            return
        if name in self._open or len(self._open) > 64:
            self._mistake(where, f"{name} contains itself")
            return
        raw = self._raw[name]
        if not isinstance(raw, dict) or not isinstance(raw.get("members"), dict):
            self._mistake(where, "expected members: {NAME: TYPE}")
            raw = {"members": {}}
        self._check_keys(where, raw, _STRUCT)
        self._open.append(name)
        members_read = [
            item
            for label, text in self._mapping(where, raw["members"])
            if (item := self._member(label, text, f"{where}.{label}")) is not None
        ]
        self._open.pop()
        union, packed = self._flag(where, raw, "union"), self._flag(where, raw, "packed")
        members, size, alignment = shapes.arrange(members_read, union=union, packed=packed)
        least = max((item.offset + self._extent(item) for item in members), default=0)
        if "size" in raw:
            stated = self._number(f"{where}.size", raw["size"])
            size = max(size, least) if stated is None else stated
            if size < least:
                self._mistake(where, f"its members take {least} bytes, more than its size {size}")
        if size > _LARGEST:
            self._mistake(where, f"{size} bytes are more than any packet holds")
        for member in members[:-1]:
            if shapes.OPEN in member.dims:
                self._mistake(f"{where}.{member.name}", "only the last member is open to the end, as in x[]")
        header = self._number(f"{where}.header", raw.get("header", 0), max(size, least)) or 0
        for member in members:
            if member.offset < header < member.offset + self._extent(member):
                self._mistake(f"{where}.{member.name}", f"the header of {header} bytes ends within it")
        self._alignments[name] = alignment
        tail = self._number(f"{where}.tail", raw.get("tail", 0)) or 0
        self._structs[name] = shapes.Struct(
            name, size, tuple(members), union, header, self._doc(where, raw), tail
        )

    def _extent(self, member: shapes.Member) -> int:
        if member.bits:
            return (member.bit + member.bits + 7) // 8
        return member.count * (member.dims[-1] if member.text else self._measures(member.type)[0])

    def _kind(self, name: str, where: str) -> shapes.Basic | str | None:
        """Return the type of a name, and read it first if it is a struct of the file; None: no such type."""
        if name in shapes.BASIC:
            return shapes.BASIC[name]
        if name in self._raw and name not in self._enums:
            self._struct(name, where)
        if name in self._enums or name in self._structs:
            return name
        if name not in self._raw:
            self._mistake(where, f"there is no type {name!r}")
        return None

    def _member(self, name: str, raw: Any, where: str) -> shapes.Wanted | None:
        about: dict[str, Any] = {}
        if isinstance(raw, dict):
            raw, about = raw.get("type"), self._about(where, raw)
        match = _TYPE.fullmatch(raw.strip()) if isinstance(raw, str) else None
        if match is None:
            self._mistake(where, f"{_printed(raw)} is not TYPE, TYPE[N], TYPE:BITS or TYPE @OFFSET")
            return None
        kind = self._kind(match["name"], where)
        if kind is None:
            return None
        try:
            dims = tuple(int(item, 0) if item else shapes.OPEN for item in _DIMENSION.findall(match["dims"]))
            offset = int(match["offset"] or "0", 0)
        except ValueError:
            self._mistake(where, f"{raw!r}: a dimension and an offset are numbers")
            return None
        bits, bit = int(match["bits"] or 0), int(match["bit"] or 0)
        size, alignment = self._measures(kind)
        basic = self._basic(kind)
        integer = basic is not None and basic.kind in _BITS and not dims
        for wrong, rule in (
            (
                shapes.OPEN in dims[1:] or max((*dims, offset)) > _LARGEST,
                "only the first dimension is left out, and all are within a packet",
            ),
            (
                match["bits"] is not None and not (integer and 0 < bits <= 8 * size),
                f"a bit-field is of an integer, 1 to {8 * size} bits wide",
            ),
            (bit > 7 or (bit and not bits), "the bit behind the point is 0 to 7, of a bit-field"),
        ):
            if wrong:
                self._mistake(where, f"{raw!r}: {rule}")
                return None
        about["order"] = match["order"] or ""
        member = shapes.Member(name, kind, offset, dims, bits, bit, 16 if match["hex"] else 10, **about)
        one = member.dims[-1] if member.text else size
        return shapes.Wanted(member, one, alignment, match["offset"] is not None)

    def _measures(self, kind: shapes.Basic | str) -> tuple[int, int]:
        basic = self._basic(kind)
        if basic is not None:
            return basic.size, basic.size
        return self._structs[str(kind)].size, self._alignments[str(kind)]

    def _basic(self, kind: shapes.Basic | str) -> shapes.Basic | None:
        if isinstance(kind, shapes.Basic):
            return kind
        return self._enums[kind].basic if kind in self._enums else None


_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80
_BITS: Final = {shapes.BasicKind.INT, shapes.BasicKind.UINT, shapes.BasicKind.BOOL}


def parse_key(raw: Any) -> shapes.Key:
    """Read a key: ``0x0801`` a MsgId, ``0x1880/6`` one with a function code, ``udp:8585`` a robot's UDP port.

    ``udp:8585/48`` means datagrams of 48 bytes to this port; ``udp:robot/48`` means any port of the robot
    link.

    Raises:
        ConfigError: the text is none of these.
    """
    word, slash, code = str(raw).partition("/")
    if word.startswith("udp:"):
        port, size = word.removeprefix("udp:"), code if slash else "1"
        any_port = port == "robot" and bool(slash)
        if not (any_port or (port.isdecimal() and 1 <= int(port) <= 0xFFFF)) or not size.isdecimal():
            raise ConfigError(f"{_printed(raw)} is not a UDP port as udp:8585, from 1 to 65535")
        return shapes.Key(shapes.UDP_KEY + (0 if any_port else int(port)), int(code) if slash else None)
    try:
        key = shapes.Key(int(word, 0), int(code, 0) if slash else None)
    except ValueError:
        _refuse(raw)
    if not 1 <= key.msg_id <= _HIGHEST or not 0 <= (key.function_code or 0) <= 0x7F:
        _refuse(raw)
    # A file does not state its version of MsgIds; those of version 1 have the secondary header bit set.
    version = VERSION_1 if key.msg_id & _SECONDARY_HEADER else VERSION_2
    if slash and not (VERSION_1.is_command(key.msg_id) or version.is_command(key.msg_id)):
        raise ConfigError(f"{_printed(raw)}: telemetry has no function code; commands are 0x1000 to 0x1fff")
    return key


def is_package(name: str) -> bool:
    """Return whether a name can be the name of a ROS package."""
    return _PACKAGE.fullmatch(name) is not None


def _refuse(raw: Any) -> NoReturn:
    msg_ids = "0x0801, from 1 to 0x1fff, nor one with a function code as 0x1880/6, nor a port as udp:8585"
    raise ConfigError(f"{_printed(raw)} is not a MsgId as {msg_ids}")


_WORDS: Final = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})


def dumps(layout: shapes.StructLayout) -> str:
    """Return the text of a layout file, with every offset."""
    lines = [
        f"edoras_structs: {LAYOUT_VERSION}",
        f"byte_order: {layout.byte_order}",
        f"package: {layout.package}",
    ]
    if layout.bindings:
        lines.append("bind:")
        lines += [f"  {key}: {_name(name)}" for key, name in sorted(layout.bindings.items(), key=_order)]
    if layout.enums:
        lines.append("enums:")
        for item in layout.enums.values():
            lines += [f"  {_name(item.name)}:", f"    type: {item.basic}", "    values:"]
            lines += [f"      {_name(label)}: {value}" for value, label in item.names.items()]
            if not item.names:
                lines[-1] += " {}"
    lines.append("structs:" + ("" if layout.structs else " {}"))
    for struct in layout.structs.values():
        lines += [f"  {_name(struct.name)}:", f"    size: {struct.size}"]
        lines += [f"    header: {struct.header}"] * bool(struct.header)
        lines += [f"    tail: {struct.tail}"] * bool(struct.tail)
        lines += ["    union: true"] * struct.union
        lines += [f"    doc: {json.dumps(struct.doc)}"] * bool(struct.doc)
        lines.append("    members:" + ("" if struct.members else " {}"))
        lines += [f"      {_name(item.name)}: {_member_text(item)}" for item in struct.members]
    return "\n".join(lines) + "\n"


def _name(name: str) -> str:
    """Return a name, quoted if YAML would read it as another type."""
    return f"'{name}'" if name.lower() in _WORDS else name


def _order(item: tuple[shapes.Key, str]) -> tuple[int, int]:
    return item[0].msg_id, -1 if item[0].function_code is None else item[0].function_code


def _member_text(member: shapes.Member) -> str:
    text = type_text(member) + f" @{member.offset}" + (f".{member.bit}" if member.bits else "")
    about = {key: getattr(member, key) for key in _ABOUT}
    words = "".join(f", {key}: {json.dumps(value)}" for key, value in about.items() if value)
    return f"{{type: '{text}'{words}}}" if words else text


def type_text(member: shapes.Member) -> str:
    """Return a member's type as it stands in a layout file, without its offset."""
    dims = "".join(f"[{size or ''}]" for size in member.dims)
    return (
        f"{member.type}{dims}"
        + f":{member.bits}" * bool(member.bits)
        + " hex" * (member.base == 16)
        + f" {member.order}" * bool(member.order)
    )


LAYOUT_NAME: Final = shapes.SHIPPED
"""Name of this layout on the command line."""
_FILE: Final = Path(__file__).with_name("cfe.json")
"""A layout file without its packets: their MsgIds depend on the version."""


@cache
def shipped_layout(msg_ids: MsgIds = VERSION_1) -> shapes.StructLayout:
    """Return the layout of the packets that cFE itself sends and takes, with MsgIds of a version."""
    bound = {
        msg_id: name
        for msg_id, name in shapes.packets(msg_ids).items()
        if msg_ids.standard(msg_id) not in cfe.PAYLOADS
    }
    layout = layout_of({**json.loads(_FILE.read_bytes()), "bind": bound}, LAYOUT_NAME)
    structs, enums = dict(layout.structs), dict(layout.enums)
    bindings = dict(layout.bindings)
    for msg_id, header in cfe.PAYLOADS.items():
        name = shapes.PACKETS[msg_id]
        structs[name] = _of_header(name, header, enums)
        bindings[shapes.Key(msg_ids.of_known(msg_id))] = name
    for size, header in shapes.DATAGRAMS.items():
        structs[header.name] = _of_header(header.name, header, enums)
        bindings[shapes.Key(shapes.UDP_KEY, size)] = header.name
    for (msg_id, code), arguments in ARGUMENTS.items():
        if arguments.size and (msg_id, code) not in BARE_TOO:
            name = command_type(msg_id, arguments.title)
            command = _of_header(name, arguments, enums)
            structs[name] = replace(command, tail=TAILS.get((msg_id, arguments.title), 0))
            bindings[shapes.Key(msg_ids.of_known(msg_id), code)] = name
    return shapes.StructLayout(structs, enums, bindings, origin=LAYOUT_NAME)


def command_type(msg_id: int, title: str) -> str:
    """Return the struct name of a command, as ``CFE_ES_StopAppCmd``.

    Args:
        msg_id: MsgId of version 1.
        title: name of the command in its application.
    """
    return f"{SERVICES[msg_id][1]}_{title.title().replace('_', '')}Cmd"


def _of_header(name: str, header: wire.Layout, enums: dict[str, shapes.Enumeration]) -> shapes.Struct:
    """Return the table of a header, or of a command's arguments, as a struct, without spare bytes."""
    members = []
    for slot in header.slots:
        item, size = slot.field, slot.end - slot.start
        kind = shapes.BASIC["char"] if item.kind == "text" else shapes.BASIC.get(f"{item.kind}{item.bits}")
        if kind is None or item.name == "spare":
            continue
        enum = shapes.Enumeration(f"{name}_{item.name}", kind, item.names)
        if item.names:
            enums[enum.name] = enum
        members.append(
            shapes.Member(
                item.name,
                enum.name if item.names else kind,
                slot.start,
                (size,) if item.kind == "text" else (),
                base=item.base,
                doc=item.doc,
            )
        )
    return shapes.Struct(name, header.size, tuple(members), doc=header.title)
