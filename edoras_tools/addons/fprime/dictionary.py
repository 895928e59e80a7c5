"""Reads the dictionary of an F Prime topology (JSON, as ``fpp-to-dict`` writes it) as a layout of structs.

Every command, channel, event and packet of channels becomes a struct, big-endian and without padding. A text
becomes an array of characters with its maximum length; on the wire it is a length and that number of
characters (:mod:`edoras_tools.addons.fprime.entry`).
"""

from __future__ import annotations

import json
import re
from math import prod
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.fprime import wire as fprime
from edoras_tools.addons.fprime.entry import BoundEntry, Entry, EventSeverity
from edoras_tools.addons.fprime.table import EntryTable
from edoras_tools.addons.fprime.wire import PacketType
from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import Database, plain_values
from edoras_tools.structs.shapes import (
    BASIC,
    ENTRY_KEY,
    Basic,
    Enumeration,
    Key,
    Member,
    Struct,
    StructLayout,
    Wanted,
    arrange,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from edoras_tools.structs import Structs

PACKAGE: Final = "fprime_msgs"
_TYPES: Final = "typeDefinitions"
_SECTIONS: Final = ("commands", "telemetryChannels", "events")
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
TIME: Final = Struct(
    "FprimeTime",
    fprime.TIME_BYTES,
    (
        Member("base", "FprimeTimeBase", 0, doc="which clock"),
        Member("context", BASIC["uint8"], 2, doc="free for the mission"),
        Member("seconds", BASIC["uint32"], 3, doc="of that clock"),
        Member("microseconds", BASIC["uint32"], 7, doc="beyond its seconds"),
    ),
    doc="when, by a clock of the flight software",
)
_TIME_BASE: Final = Enumeration("FprimeTimeBase", BASIC["uint16"], fprime.TIME_BASES)


class _Type(msgspec.Struct, frozen=True):
    """A type: a basic type, an enumeration or a struct, with the dimensions of an array of them."""

    base: Basic | str
    size: int
    dims: tuple[int, ...] = ()
    text: int = 0

    @property
    def bytes(self) -> int:
        return prod(self.dims) * self.size

    def member(self, name: str, doc: str) -> Wanted:
        dims = (*self.dims, self.text) if self.text else self.dims
        return Wanted(Member(name, self.base, 0, dims, doc=doc), self.size, 1, placed=False)


class DictionaryEntries(tuple[Entry, ...]):
    """The entries of a dictionary in the core's interface; see ``structs.shapes.LayoutEntries``."""

    __slots__ = ()

    def bind(self, key: Key, layout: StructLayout, struct: Struct, type_name: str) -> BoundEntry:
        """Return the struct of an entry that makes its messages."""
        return BoundEntry(self[key.msg_id - ENTRY_KEY], key, layout, struct, type_name)

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


def read_dictionary(data: bytes, name: str) -> StructLayout:
    """Read a dictionary.

    Args:
        data: content of the file.
        name: name of the file in messages.

    Raises:
        ConfigError: it has mistakes: all of them, one line each.
    """
    reader = _DictionaryReader(plain_values(data, name), name)
    layout = reader.layout()
    if reader.mistakes:
        raise ConfigError(*dict.fromkeys(reader.mistakes))
    return layout


DICTIONARIES: Final = Database(is_dictionary, read_dictionary)


class _DictionaryReader(msgspec.Struct):
    raw: Mapping[str, Any]
    name: str
    mistakes: list[str] = msgspec.field(default_factory=list)
    enums: dict[str, Enumeration] = msgspec.field(default_factory=dict)
    structs: dict[str, Struct] = msgspec.field(default_factory=dict)
    types: dict[str, _Type | None] = msgspec.field(default_factory=dict)
    entries: dict[tuple[int, int], tuple[Entry, Struct]] = msgspec.field(default_factory=dict)
    definitions: dict[str, tuple[str, Any]] = msgspec.field(default_factory=dict)

    def layout(self) -> StructLayout:
        self.enums[_TIME_BASE.name], self.structs[TIME.name] = _TIME_BASE, TIME
        self.definitions = {
            item["qualifiedName"]: (where, item)
            for where, item in self._items(_TYPES, self.raw.get(_TYPES))
            if self._text(where, item, "qualifiedName")
        }
        self._configuration()
        for where, item in self._items("commands", self.raw.get("commands", [])):
            self._entry(where, item, PacketType.COMMAND, "opcode", self._parameters(where, item))
        channels: dict[str, Wanted | None] = {}
        for where, item in self._items("telemetryChannels", self.raw.get("telemetryChannels", [])):
            value = self._value(where, item, "value")
            channels[str(item.get("name"))] = value
            self._entry(where, item, PacketType.TELEMETRY, "id", [value])
        for where, item in self._items("events", self.raw.get("events", [])):
            self._entry(where, item, PacketType.EVENT, "id", self._parameters(where, item))
        for where, item in self._items("telemetryPacketSets", self.raw.get("telemetryPacketSets", [])):
            for place, packet in self._items(f"{where}.members", item.get("members", [])):
                self._packet(place, packet, channels)
        pairs = sorted(self.entries.items())
        keys = [Key(ENTRY_KEY + rank, 0) for rank in range(len(pairs))]
        self.structs |= {struct.name: struct for _, (_, struct) in pairs}
        return StructLayout(
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
                under = under.get("name") if isinstance(under, dict) else None
                if item.get("kind") != "alias" or under == usual:
                    break
                if under in _PLAIN or under not in self.definitions:
                    self._mistake(where, f"{name} is {under}; only {usual}, the default, can be read")
                    break
                item = self.definitions[under][1]
        where, item = self.definitions.get("ComCfg.Apid", ("", {}))
        constants = item.get("enumeratedConstants", [])
        for place, constant in self._items(f"{where}.enumeratedConstants", constants):
            expected = _APIDS.get(str(constant.get("name")))
            if expected is not None and constant.get("value") != expected:
                text = f"{constant['name']} is {_short(constant.get('value'))}"
                self._mistake(place, f"{text}; only {int(expected)}, the default, can be read")

    def _entry(
        self, where: str, item: Mapping[str, Any], kind: PacketType, id_name: str, values: list[Wanted | None]
    ) -> None:
        """Store the contents of packets of one id."""
        name = self._text(where, item, "name")
        number = self._number(where, item, id_name, most=fprime.ENTRY_HEADERS[kind].slots[0].mask)
        severity = EventSeverity.of(item.get("severity")) if kind is PacketType.EVENT else None
        if kind is PacketType.EVENT and severity is None:
            self._mistake(
                where,
                f"severity {item.get('severity')!r} is not one of {', '.join(EventSeverity.__members__)}",
            )
        form = item.get("format", "")
        if not isinstance(form, str):
            self._mistake(where, f"format {form!r} is not text")
        if not name or number is None or None in values:
            return
        other = self.entries.get((kind, number))
        if other is not None:
            self._mistake(where, f"{id_name} {number:#x} of {name} is that of {other[0].name}, too")
            return
        entry = Entry(kind, number, name, severity, str(form))
        readable = [item for item in values if item is not None]
        time = Wanted(Member("time", TIME.name, 0), TIME.size, 1, placed=False)
        members, size, _ = arrange([*[time] * entry.timed, *readable], packed=True)
        if size > _LARGEST:
            self._mistake(where, f"{size} bytes are more than any packet holds")
            return
        struct = Struct(f"{entry.word}_{_plain(name)}", size, tuple(members), doc=self._doc(item))
        self.entries[kind, number] = entry, struct

    def _packet(self, where: str, item: Mapping[str, Any], channels: Mapping[str, Wanted | None]) -> None:
        """Store a packet of channels, whose values have fixed positions."""
        names = item.get("members")
        values: list[Wanted | None] = []
        for name in names if isinstance(names, list) else ():
            if not isinstance(name, str) or name not in channels:
                self._mistake(where, f"there is no channel {name!r}")
                values.append(None)
                continue
            value = channels[name]
            values.append(value and replace(value, member=replace(value.member, name=_plain(name))))
        if not isinstance(names, list):
            self._mistake(where, "members: expected a list of channels")
        self._entry(where, item, PacketType.PACKETIZED_TELEMETRY, "id", values)

    def _parameters(self, where: str, item: Mapping[str, Any]) -> list[Wanted | None]:
        return [
            self._value(place, one, str(one.get("name")))
            for place, one in self._items(f"{where}.formalParams", item.get("formalParams", []))
            if self._text(place, one, "name")
        ]

    def _value(self, where: str, item: Mapping[str, Any], name: str) -> Wanted | None:
        kind = self._type(f"{where}.type", item.get("type"), ())
        return None if kind is None else kind.member(name, self._doc(item))

    def _type(self, where: str, raw: Any, within: tuple[str, ...]) -> _Type | None:
        """Return the type that is named where it is used; None after a mistake."""
        name = raw.get("name") if isinstance(raw, dict) else None
        if not isinstance(name, str):
            self._mistake(where, f"{_short(raw)} is not a type as {{'name': 'U32', ...}}")
            return None
        if name in _PLAIN:
            basic = BASIC[_PLAIN[name]]
            return _Type(basic, basic.size)
        if name == "string":
            size = self._number(where, raw, "size", 1, _LARGEST)
            return None if size is None else _Type(BASIC["char"], size, (), size)
        if name in self.types:
            return self.types[name]
        if name not in self.definitions:
            self._mistake(where, f"there is no type {name!r} in typeDefinitions")
        elif name in within or len(within) > 64:
            self._mistake(self.definitions[name][0], f"{name} contains itself")
        else:
            self.types[name] = self._definition(*self.definitions[name], name, (*within, name))
        return self.types.setdefault(name, None)

    def _definition(
        self, where: str, item: Mapping[str, Any], name: str, within: tuple[str, ...]
    ) -> _Type | None:
        """Return a type of ``typeDefinitions``."""
        kind = item.get("kind")
        if kind == "alias":
            return self._type(f"{where}.underlyingType", item.get("underlyingType"), within)
        if kind == "array":
            return self._array(
                where, self._type(f"{where}.elementType", item.get("elementType"), within), item
            )
        if kind == "enum":
            return self._enum(where, item, name)
        if kind == "struct":
            return self._struct(where, item, name, within)
        self._mistake(where, f"kind {kind!r} is not alias, array, enum or struct")
        return None

    def _array(self, where: str, element: _Type | None, item: Mapping[str, Any]) -> _Type | None:
        size = self._number(where, item, "size", 1, _LARGEST)
        if element is None or size is None:
            return None
        if size * element.bytes > _LARGEST:
            self._mistake(where, f"{size * element.bytes} bytes are more than any packet holds")
            return None
        return _Type(element.base, element.size, (size, *element.dims), element.text)

    def _enum(self, where: str, item: Mapping[str, Any], name: str) -> _Type | None:
        base = self._type(f"{where}.representationType", item.get("representationType"), ())
        if base is None or not isinstance(base.base, Basic) or "int" not in str(base.base) or base.dims:
            self._mistake(where, f"{name} is not represented by an integer")
            return None
        names: dict[int, str] = {}
        for place, one in self._items(f"{where}.enumeratedConstants", item.get("enumeratedConstants", [])):
            label, value = self._text(place, one, "name"), one.get("value")
            if isinstance(value, bool) or not isinstance(value, int) or not base.base.holds(value):
                self._mistake(place, f"value {_short(value)} does not fit {base.base}")
            elif label:
                names.setdefault(value, label)
        plain = self._free(name)
        self.enums[plain] = Enumeration(plain, base.base, names)
        return _Type(plain, base.size)

    def _struct(
        self, where: str, item: Mapping[str, Any], name: str, within: tuple[str, ...]
    ) -> _Type | None:
        raw = item.get("members")
        if not isinstance(raw, dict) or not raw:
            self._mistake(where, f"members of {name}: expected {{NAME: {{type: ..., index: ...}}}}")
            return None
        by_index: dict[int, Wanted | None] = {}
        for label, one in raw.items():
            place = f"{where}.members.{label}"
            if not isinstance(one, dict) or not _NAME.fullmatch(label):
                self._mistake(place, f"{_short(one)} is not a member")
                return None
            kind = self._type(f"{place}.type", one.get("type"), within)
            if one.get("size") is not None:
                kind = self._array(place, kind, one)
            index = self._number(place, one, "index")
            if index in by_index:
                self._mistake(place, f"index {index} is there twice")
            by_index[-1 if index is None else index] = (
                None if kind is None else kind.member(label, self._doc(one))
            )
        ordered = [by_index[index] for index in sorted(by_index)]
        if None in ordered:
            return None
        members, size, _ = arrange([one for one in ordered if one is not None], packed=True)
        if size > _LARGEST:
            self._mistake(where, f"{size} bytes are more than any packet holds")
            return None
        plain = self._free(name)
        self.structs[plain] = Struct(plain, size, tuple(members), doc=self._doc(item))
        return _Type(plain, size)

    def _free(self, name: str) -> str:
        """Return the name of a type without dots; a different one if it is already used."""
        plain = _plain(name)
        while plain in self.enums or plain in self.structs or plain in BASIC:
            plain += "_"
        return plain

    def _items(self, where: str, raw: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
        if not isinstance(raw, list):
            self._mistake(where, f"{_short(raw)} is not a list")
            return
        for index, item in enumerate(raw):
            if isinstance(item, dict):
                yield f"{where}[{index}]", item
            else:
                self._mistake(f"{where}[{index}]", f"{_short(item)} is not an object")

    def _text(self, where: str, item: Mapping[str, Any], key: str) -> str:
        value = item.get(key)
        if isinstance(value, str) and _NAME.fullmatch(value):
            return value
        self._mistake(where, f"{key} is missing" if value is None else f"{key} {_short(value)} is not a name")
        return ""

    def _number(
        self, where: str, item: Mapping[str, Any], key: str, least: int = 0, most: int = _HIGHEST
    ) -> int | None:
        value = item.get(key)
        if isinstance(value, int) and not isinstance(value, bool) and least <= value <= most:
            return value
        text = f"{key} is missing" if value is None else f"{key} {_short(value)}"
        self._mistake(where, f"{text}; expected a number of {least} to {most}")
        return None

    def _doc(self, item: Mapping[str, Any]) -> str:
        return " ".join(str(item.get("annotation") or "").split())

    def _mistake(self, where: str, text: str) -> None:
        self.mistakes.append(f"{self.name}: {where + ': ' if where else ''}{text}")


def _plain(name: str) -> str:
    """Return a qualified name without dots."""
    return name.replace(".", "_")


def _short(raw: Any) -> str:
    text = repr(raw)
    return text if len(text) <= 80 else f"{text[:77]}..."
