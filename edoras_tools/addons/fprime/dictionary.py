"""Reads the dictionary of an F Prime topology (JSON, as ``fpp-to-dict`` writes it) as a layout of structs.

Every command, channel, event and packet of channels becomes a struct, big-endian and without padding. A text
becomes an array of characters with its maximum length; on the wire it is a length and that number of
characters (:mod:`edoras_tools.addons.fprime.table`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import prod
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.fprime import link as fprime
from edoras_tools.addons.fprime.link import PacketType
from edoras_tools.addons.fprime.table import BoundEntry, Entry, EntryTable, EventSeverity
from edoras_tools.errors import ConfigError
from edoras_tools.structs import Structs, shapes
from edoras_tools.structs.files import Database, plain_values

PACKAGE: Final = "fprime_msgs"
_TYPES: Final = "typeDefinitions"
_SECTIONS: Final = {
    "commands": PacketType.COMMAND,
    "telemetryChannels": PacketType.TELEMETRY,
    "events": PacketType.EVENT,
}
_PLAIN: Final = {
    **{
        f"{letter}{bits}": f"{kind}{bits}"
        for letter, kind in (("U", "uint"), ("I", "int"))
        for bits in (8, 16, 32, 64)
    },
    "F32": "float32",
    "F64": "float64",
    "bool": "bool",
}
_WIDTHS: Final = {
    "FwPacketDescriptorType": "U16",
    "FwOpcodeType": "U32",
    "FwChanIdType": "U32",
    "FwEventIdType": "U32",
    "FwTlmPacketizeIdType": "U16",
    "FwTimeBaseStoreType": "U16",
    "FwTimeContextStoreType": "U8",
    "FwSizeStoreType": "U16",
}
"""Configurable widths, with the values that are read here: the default configuration since version 4."""
_APIDS: Final = {
    "FW_PACKET_COMMAND": PacketType.COMMAND,
    "FW_PACKET_TELEM": PacketType.TELEMETRY,
    "FW_PACKET_LOG": PacketType.EVENT,
    "FW_PACKET_PACKETIZED_TLM": PacketType.PACKETIZED_TELEMETRY,
}
_NAME: Final = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*", re.ASCII)
_LARGEST: Final = 1 << 16
"""Maximum size of a value, bytes: that of a packet."""
_HIGHEST: Final = (1 << 32) - 1
TIME: Final = shapes.Struct(
    "FprimeTime",
    fprime.TIME_BYTES,
    (
        shapes.Member("base", "FprimeTimeBase", 0, doc="which clock"),
        shapes.Member("context", shapes.BASIC["uint8"], 2, doc="free for the mission"),
        shapes.Member("seconds", shapes.BASIC["uint32"], 3, doc="of that clock"),
        shapes.Member("microseconds", shapes.BASIC["uint32"], 7, doc="beyond its seconds"),
    ),
    doc="when, by a clock of the flight software",
)
_TIME_BASE: Final = shapes.Enumeration("FprimeTimeBase", shapes.BASIC["uint16"], fprime.TIME_BASES)


class _Type(msgspec.Struct, frozen=True):
    """A type: a basic type, an enumeration or a struct, with the dimensions of an array of them."""

    base: shapes.Basic | str
    size: int
    dims: tuple[int, ...] = ()
    text: int = 0

    @property
    def bytes(self) -> int:
        return prod(self.dims) * self.size

    def member(self, name: str, doc: str) -> shapes.Wanted:
        dims = (*self.dims, self.text) if self.text else self.dims
        return shapes.Wanted(shapes.Member(name, self.base, 0, dims, doc=doc), self.size, 1, placed=False)


class DictionaryEntries(tuple[Entry, ...]):
    """The entries of a dictionary in the core's interface; see ``structs.shapes.LayoutEntries``."""

    __slots__ = ()

    def bind(
        self, key: shapes.Key, layout: shapes.StructLayout, struct: shapes.Struct, type_name: str
    ) -> BoundEntry:
        """Return the struct of an entry that makes its messages."""
        return BoundEntry(self[key.msg_id - shapes.ENTRY_KEY], key, layout, struct, type_name)

    def table(self, structs: Structs) -> EntryTable:
        """Return the table of the bound entries."""
        return EntryTable([item for item in structs.all if isinstance(item, BoundEntry)], structs)


def is_dictionary(data: bytes) -> bool:
    """Return whether a file's content is a dictionary of F Prime."""
    if _TYPES.encode() not in data or not data.lstrip().startswith(b"{"):
        return False
    try:
        raw = json.loads(data)
    except (ValueError, RecursionError):
        return False
    return _TYPES in raw and any(name in raw for name in _SECTIONS)


def read_dictionary(data: bytes, name: str) -> shapes.StructLayout:
    """Read a dictionary.

    Args:
        data: content of the file.
        name: name of the file in messages.

    Raises:
        ConfigError: it has mistakes: the first of each entry, one line each.
    """
    reader = _DictionaryReader(plain_values(data, name), name)
    layout = reader.layout()
    if reader.mistakes:
        raise ConfigError(*dict.fromkeys(map(str, reader.mistakes)))
    return layout


DICTIONARIES: Final = Database(is_dictionary, read_dictionary)


class _DictionaryReader(msgspec.Struct):
    """Reads the sections one by one; the first mistake of each entry is kept."""

    raw: Mapping[str, Any]
    name: str
    mistakes: list[ConfigError] = msgspec.field(default_factory=list)
    enums: dict[str, shapes.Enumeration] = msgspec.field(default_factory=dict)
    structs: dict[str, shapes.Struct] = msgspec.field(default_factory=dict)
    types: dict[str, _Type] = msgspec.field(default_factory=dict)
    entries: dict[tuple[int, int], tuple[Entry, shapes.Struct]] = msgspec.field(default_factory=dict)
    definitions: dict[str, tuple[str, Any]] = msgspec.field(default_factory=dict)
    channels: dict[str, shapes.Wanted | None] = msgspec.field(default_factory=dict)

    def layout(self) -> shapes.StructLayout:
        self.enums[_TIME_BASE.name], self.structs[TIME.name] = _TIME_BASE, TIME
        for where, item in self._items("", self.raw, _TYPES):
            with self._noting():
                self.definitions[self._text(where, item, "qualifiedName")] = where, item
        self._configuration()
        for section, kind in _SECTIONS.items():
            for where, item in self._items("", self.raw, section):
                with self._noting():
                    self._entry(where, item, kind, self._values(where, item, kind))
        for where, item in self._items("", self.raw, "telemetryPacketSets"):
            for place, packet in self._items(where, item, "members"):
                with self._noting():
                    kind = PacketType.PACKETIZED_TELEMETRY
                    self._entry(place, packet, kind, self._packet(place, packet))
        pairs = sorted(self.entries.items())
        keys = [shapes.Key(shapes.ENTRY_KEY + rank, 0) for rank in range(len(pairs))]
        self.structs |= {struct.name: struct for _, (_, struct) in pairs}
        return shapes.StructLayout(
            self.structs,
            self.enums,
            {key: struct.name for key, (_, (_, struct)) in zip(keys, pairs, strict=True)},
            "big",
            PACKAGE,
            self.name,
            DictionaryEntries(entry for _, (entry, _) in pairs),
        )

    def _configuration(self) -> None:
        """Refuse a project whose headers differ from those that are read."""
        for name, usual in _WIDTHS.items():
            where, item = self.definitions.get(name, ("", {}))
            for _ in range(len(self.definitions)):
                under = item.get("underlyingType")
                under = str(under.get("name")) if isinstance(under, dict) else None
                if item.get("kind") != "alias" or under == usual:
                    break
                if under in _PLAIN or under not in self.definitions:
                    text = f"{name} is {under}; only {usual}, the default, can be read"
                    self.mistakes.append(self._mistake(where, text))
                    break
                item = self.definitions[under][1]
        where, item = self.definitions.get("ComCfg.Apid", ("", {}))
        for place, constant in self._items(where, item, "enumeratedConstants"):
            expected = _APIDS.get(str(constant.get("name")))
            if expected is not None and constant.get("value") != expected:
                text = f"{constant['name']} is {_short(constant.get('value'))}"
                text += f"; only {int(expected)}, the default, can be read"
                self.mistakes.append(self._mistake(place, text))

    def _entry(
        self, where: str, item: Mapping[str, Any], kind: PacketType, values: list[shapes.Wanted]
    ) -> None:
        """Store the contents of packets of one id."""
        name, id_name = self._text(where, item, "name"), "opcode" if kind is PacketType.COMMAND else "id"
        number = self._number(where, item, id_name, most=fprime.ENTRY_HEADERS[kind].slots[0].mask)
        severity = EventSeverity.of(item.get("severity")) if kind is PacketType.EVENT else None
        if kind is PacketType.EVENT and severity is None:
            choices = ", ".join(EventSeverity.__members__)
            raise self._mistake(where, f"severity {item.get('severity')!r} is not one of {choices}")
        form = item.get("format", "")
        if not isinstance(form, str):
            raise self._mistake(where, f"format {form!r} is not text")
        other = self.entries.get((kind, number))
        if other is not None:
            raise self._mistake(where, f"{id_name} {number:#x} of {name} is that of {other[0].name}, too")
        entry = Entry(kind, number, name, severity, form)
        time = shapes.Wanted(shapes.Member("time", TIME.name, 0), TIME.size, 1, placed=False)
        struct = self._arranged(where, item, f"{entry.word}_{_plain(name)}", [*[time] * entry.timed, *values])
        self.entries[kind, number] = entry, struct

    def _values(self, where: str, item: Mapping[str, Any], kind: PacketType) -> list[shapes.Wanted]:
        """Return the parameters of a command or an event, or the value of a channel."""
        if kind is PacketType.TELEMETRY:
            name = str(item.get("name"))
            self.channels[name] = None
            self.channels[name] = value = self._value(where, item, "value")
            return [value]
        return [
            self._value(place, one, self._text(place, one, "name"))
            for place, one in self._items(where, item, "formalParams")
        ]

    def _packet(self, where: str, item: Mapping[str, Any]) -> list[shapes.Wanted]:
        """Return the channels of a packet, whose values have fixed positions."""
        names, values = item.get("members"), []
        if not isinstance(names, list):
            raise self._mistake(where, "members: expected a list of channels")
        for name in names:
            if not isinstance(name, str) or name not in self.channels:
                raise self._mistake(where, f"there is no channel {name!r}")
            if value := self.channels[name]:  # else the channel has a mistake of its own
                values.append(replace(value, member=replace(value.member, name=_plain(name))))
        return values

    def _value(self, where: str, item: Mapping[str, Any], name: str) -> shapes.Wanted:
        return self._type(f"{where}.type", item.get("type"), ()).member(name, _doc(item))

    def _type(self, where: str, raw: Any, within: tuple[str, ...]) -> _Type:
        """Return the type that is named where it is used."""
        name = raw.get("name") if isinstance(raw, dict) else None
        if not isinstance(name, str):
            raise self._mistake(where, f"{_short(raw)} is not a type as {{'name': 'U32', ...}}")
        if name in _PLAIN:
            basic = shapes.BASIC[_PLAIN[name]]
            return _Type(basic, basic.size)
        if name == "string":
            size = self._number(where, raw, "size", 1, _LARGEST)
            return _Type(shapes.BASIC["char"], size, (), size)
        if name not in self.types:
            if name not in self.definitions:
                raise self._mistake(where, f"there is no type {name!r} in typeDefinitions")
            if name in within or len(within) > 64:
                raise self._mistake(self.definitions[name][0], f"{name} contains itself")
            self.types[name] = self._definition(*self.definitions[name], name, (*within, name))
        return self.types[name]

    def _definition(self, where: str, item: Mapping[str, Any], name: str, within: tuple[str, ...]) -> _Type:
        """Return a type of ``typeDefinitions``."""
        kind = item.get("kind")
        if kind == "alias":
            return self._type(f"{where}.underlyingType", item.get("underlyingType"), within)
        if kind == "array":
            element = self._type(f"{where}.elementType", item.get("elementType"), within)
            return self._array(where, element, item)
        if kind == "enum":
            return self._enum(where, item, name)
        if kind == "struct":
            return self._struct(where, item, name, within)
        raise self._mistake(where, f"kind {kind!r} is not alias, array, enum or struct")

    def _array(self, where: str, element: _Type, item: Mapping[str, Any]) -> _Type:
        size = self._number(where, item, "size", 1, _LARGEST)
        self._check_size(where, size * element.bytes)
        return _Type(element.base, element.size, (size, *element.dims), element.text)

    def _enum(self, where: str, item: Mapping[str, Any], name: str) -> _Type:
        base = self._type(f"{where}.representationType", item.get("representationType"), ())
        if not isinstance(base.base, shapes.Basic) or "int" not in str(base.base) or base.dims:
            raise self._mistake(where, f"{name} is not represented by an integer")
        names: dict[int, str] = {}
        for place, one in self._items(where, item, "enumeratedConstants"):
            label, value = self._text(place, one, "name"), one.get("value")
            if isinstance(value, bool) or not isinstance(value, int) or not base.base.holds(value):
                raise self._mistake(place, f"value {_short(value)} does not fit {base.base}")
            names.setdefault(value, label)
        plain = self._free(name)
        self.enums[plain] = shapes.Enumeration(plain, base.base, names)
        return _Type(plain, base.size)

    def _struct(self, where: str, item: Mapping[str, Any], name: str, within: tuple[str, ...]) -> _Type:
        raw = item.get("members")
        if not isinstance(raw, dict) or not raw:
            raise self._mistake(where, f"members of {name}: expected {{NAME: {{type: ..., index: ...}}}}")
        by_index: dict[int, shapes.Wanted] = {}
        for label, one in raw.items():
            place = f"{where}.members.{label}"
            if not isinstance(one, dict) or not _NAME.fullmatch(label):
                raise self._mistake(place, f"{_short(one)} is not a member")
            kind = self._type(f"{place}.type", one.get("type"), within)
            if one.get("size") is not None:
                kind = self._array(place, kind, one)
            index = self._number(place, one, "index")
            if index in by_index:
                raise self._mistake(place, f"index {index} is there twice")
            by_index[index] = kind.member(label, _doc(one))
        plain = self._free(name)
        struct = self._arranged(where, item, plain, [by_index[index] for index in sorted(by_index)])
        self.structs[plain] = struct
        return _Type(plain, struct.size)

    def _arranged(
        self, where: str, item: Mapping[str, Any], name: str, values: list[shapes.Wanted]
    ) -> shapes.Struct:
        """Return a struct of values that follow each other without padding."""
        members, size, _ = shapes.arrange(values, packed=True)
        self._check_size(where, size)
        return shapes.Struct(name, size, tuple(members), doc=_doc(item))

    def _check_size(self, where: str, size: int) -> None:
        if size > _LARGEST:
            raise self._mistake(where, f"{size} bytes are more than any packet holds")

    def _free(self, name: str) -> str:
        """Return the name of a type without dots; a different one if it is already used."""
        plain = _plain(name)
        while plain in self.enums or plain in self.structs or plain in shapes.BASIC:
            plain += "_"
        return plain

    def _items(
        self, where: str, item: Mapping[str, Any], key: str
    ) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield the objects of a list with their places."""
        raw, where = item.get(key, []), f"{where}.{key}".lstrip(".")
        if not isinstance(raw, list):
            self.mistakes.append(self._mistake(where, f"{_short(raw)} is not a list"))
            return
        for index, one in enumerate(raw):
            place = f"{where}[{index}]"
            if isinstance(one, dict):
                yield place, one
            else:
                self.mistakes.append(self._mistake(place, f"{_short(one)} is not an object"))

    def _text(self, where: str, item: Mapping[str, Any], key: str) -> str:
        value = item.get(key)
        if isinstance(value, str) and _NAME.fullmatch(value):
            return value
        text = f"{key} is missing" if value is None else f"{key} {_short(value)} is not a name"
        raise self._mistake(where, text)

    def _number(
        self, where: str, item: Mapping[str, Any], key: str, least: int = 0, most: int = _HIGHEST
    ) -> int:
        value = item.get(key)
        if isinstance(value, int) and not isinstance(value, bool) and least <= value <= most:
            return value
        text = f"{key} is missing" if value is None else f"{key} {_short(value)}"
        raise self._mistake(where, f"{text}; expected a number of {least} to {most}")

    def _mistake(self, where: str, text: str) -> ConfigError:
        return ConfigError(f"{self.name}: {where + ': ' if where else ''}{text}")

    @contextmanager
    def _noting(self) -> Iterator[None]:
        """Keep the mistake of an entry, and go on with the next one."""
        try:
            yield
        except ConfigError as error:
            self.mistakes.append(error)


def _doc(item: Mapping[str, Any]) -> str:
    return " ".join(str(item.get("annotation") or "").split())


def _plain(name: str) -> str:
    """Return a qualified name without dots."""
    return name.replace(".", "_")


def _short(raw: Any) -> str:
    text = repr(raw)
    return text if len(text) <= 80 else f"{text[:77]}..."
