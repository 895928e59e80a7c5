"""XTCE 1.2 (OMG formal/2018-10-04): telemetry containers, and commands of fixed size.

The length of a string is read as its three low bits and the rest, least significant byte first. The low bits
select the container of the following items, because they determine its padding. Strings of more than 255
bytes end a packet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from xml.etree import ElementTree as ET

from msgspec.structs import replace

from edoras_tools.addons.codegen.ground.packets import (
    REMAINDERS,
    PacketItem,
    StringItem,
    command_header,
    header_items,
    identifier,
    telemetry_items,
)
from edoras_tools.wire import ccsds

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.addons.codegen.ground.packets import GroundPacket, Items
    from edoras_tools.structs.shapes import Member, Range
    from edoras_tools.wire.cfe import Headers

_NAMESPACE: Final = "http://www.omg.org/spec/XTCE/20180204"
_ROOT: Final = "CCSDSPacket"
_TELEMETRY: Final = "cFETelemetry"
_HIGH, _LOW, _REST = "length_high", "length_low", "length_rest"
_LENGTH: Final = (
    PacketItem(_HIGH, "uint", 5, "bytes of the string, a NUL at its end included: bits 3 to 7", little=False),
    PacketItem(_LOW, "uint", 3, "bits 0 to 2", little=False),
    PacketItem(_REST, "uint", 24, "bits 8 to 31: 0"),
)


def xtce(
    name: str, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket], headers: Headers
) -> bytes:
    """Return the XML of a space system.

    Args:
        name: name of the space system.
        telemetry: packets from cFS.
        commands: packets to cFS; each must be of fixed size.
        headers: headers of the cFE.
    """
    return _System(name, headers).document(telemetry, commands)


class _System:
    def __init__(self, name: str, headers: Headers) -> None:
        self._headers = headers
        self._root = ET.Element("SpaceSystem", {"xmlns": _NAMESPACE, "name": identifier(name)})
        telemetry = ET.SubElement(self._root, "TelemetryMetaData")
        self._types = ET.SubElement(telemetry, "ParameterTypeSet")
        self._parameters = ET.SubElement(telemetry, "ParameterSet")
        self._containers = ET.SubElement(telemetry, "ContainerSet")
        self._known: set[str] = set()

    def document(self, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket]) -> bytes:
        self._container(_ROOT, header_items(ccsds.PRIMARY), abstract=True)
        conditions = {"packet_type": ccsds.TELEMETRY_TYPE, "secondary_header_flag": 1}
        items = telemetry_items(self._headers)
        self._container(_TELEMETRY, items, base=_ROOT, conditions=conditions, abstract=True)
        for packet in telemetry:
            ids = {"apid": packet.apid}
            self._container(packet.name, packet.items, f"{packet.name}_", _TELEMETRY, ids, doc=packet.doc)
        some = list(commands)
        if some:
            self._commands(some)
        ET.indent(self._root)
        return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(self._root) + b"\n"

    def _container(
        self,
        name: str,
        items: Items,
        prefix: str = "",
        base: str = "",
        conditions: dict[str, int] | None = None,
        *,
        doc: str = "",
        abstract: bool = False,
    ) -> ET.Element:
        """Append a container, and those of the items behind its string; return its entries."""
        container = ET.SubElement(self._containers, "SequenceContainer", {"name": name})
        if doc:
            container.set("shortDescription", doc)
        if abstract:
            container.set("abstract", "true")
        entries = ET.SubElement(container, "EntryList")
        for item in items:
            for part in _length_of(item) if isinstance(item, StringItem) else (item,):
                ET.SubElement(entries, "ParameterRefEntry", {"parameterRef": self._parameter(prefix, part)})
        if base:
            inherited = ET.SubElement(container, "BaseContainer", {"containerRef": base})
            criteria = ET.SubElement(ET.SubElement(inherited, "RestrictionCriteria"), "ComparisonList")
            for field, value in (conditions or {}).items():
                ET.SubElement(criteria, "Comparison", {"parameterRef": field, "value": str(value)})
        if items and isinstance(items[-1], StringItem):
            self._after(name, items[-1], prefix)
        return entries

    def _after(self, base: str, string: StringItem, prefix: str) -> None:
        """Append a container for each remainder of a string's length: its characters, and later items."""
        high, low, rest = (identifier(prefix + part.name) for part in _length_of(string))
        for remainder, items in enumerate(string.after):
            text = f"{prefix}{identifier(string.name)}"
            kind = f"string_{identifier(string.name)}_{prefix}{remainder}"
            self._string(kind, high, 8 * (remainder - 1))
            container = f"{base}_{remainder}"
            entry = f"{text}_{remainder}"
            self._declare(entry, kind, string.name)
            end = PacketItem("", "bytes", 8, "NUL")
            entries = self._container(container, (end, *items), prefix, base, {low: remainder, rest: 0})
            entries.insert(0, ET.Element("ParameterRefEntry", {"parameterRef": entry}))

    def _string(self, name: str, high: str, intercept_bits: int) -> None:
        if name in self._known:
            return
        self._known.add(name)
        string_type = ET.SubElement(self._types, "StringParameterType", {"name": name})
        encoding = ET.SubElement(string_type, "StringDataEncoding", {"encoding": "UTF-8"})
        variable = ET.SubElement(encoding, "Variable", {"maxSizeInBits": str(255 * 8)})
        dynamic = ET.SubElement(variable, "DynamicValue")
        ET.SubElement(dynamic, "ParameterInstanceRef", {"parameterRef": high})
        slope = {"slope": str(8 * REMAINDERS), "intercept": str(intercept_bits)}
        ET.SubElement(dynamic, "LinearAdjustment", slope)

    def _parameter(self, prefix: str, item: PacketItem) -> str:
        kind = _type_name(item)
        if kind not in self._known:
            self._known.add(kind)
            _data_type(self._types, "Parameter", kind, item)
        name = identifier(prefix + (item.name or f"padding_{item.bits // 8}"))
        self._declare(name, kind, item.doc or item.name)
        return name

    def _declare(self, name: str, kind: str, doc: str) -> None:
        if name not in self._known:
            self._known.add(name)
            attributes = {"name": name, "parameterTypeRef": kind, "shortDescription": doc}
            ET.SubElement(self._parameters, "Parameter", attributes)

    def _commands(self, packets: Sequence[GroundPacket]) -> None:
        meta = ET.SubElement(self._root, "CommandMetaData")
        types = ET.SubElement(meta, "ArgumentTypeSet")
        command_set = ET.SubElement(meta, "MetaCommandSet")
        declared: set[str] = set()
        for packet in packets:
            command = ET.SubElement(
                command_set, "MetaCommand", {"name": packet.name, "shortDescription": packet.doc}
            )
            arguments = ET.SubElement(command, "ArgumentList")
            container = ET.SubElement(command, "CommandContainer", {"name": f"{packet.name}_packet"})
            entries = ET.SubElement(container, "EntryList")
            _fixed(entries, command_header(packet, self._headers))
            for part in packet.items:
                assert isinstance(part, PacketItem)
                if part.fixed:
                    _fixed(entries, part.fixed)
                    continue
                kind = f"arg_{_type_name(part)}"
                if kind not in declared:
                    declared.add(kind)
                    _data_type(types, "Argument", kind, part)
                name = identifier(part.name)
                argument = {"name": name, "argumentTypeRef": kind, "shortDescription": part.doc or part.name}
                ET.SubElement(arguments, "Argument", argument)
                ET.SubElement(entries, "ArgumentRefEntry", {"argumentRef": name})


def _fixed(entries: ET.Element, value: bytes) -> None:
    fixed = {"binaryValue": value.hex().upper(), "sizeInBits": str(8 * len(value))}
    ET.SubElement(entries, "FixedValueEntry", fixed)


def _type_name(item: PacketItem) -> str:
    order = "" if item.bits <= 8 or item.encoding in {"bytes", "text"} else "_le" if item.little else "_be"
    words = [item.enum.name] if item.enum else []
    if item.member:
        words += [item.member.unit, *map(str, item.member.polynomial), item.member.limits]
    return "_".join([f"{item.encoding}{item.bits}{order}", *map(identifier, words)])


def _length_of(string: StringItem) -> list[PacketItem]:
    return [replace(part, name=f"{string.name}.{part.name}") for part in _LENGTH]


def _data_type(types: ET.Element, role: str, name: str, item: PacketItem) -> None:
    order = {} if item.bits <= 8 else {"byteOrder": "leastSignificantByteFirst"} if item.little else {}
    bits = {"sizeInBits": str(item.bits)}
    member = item.member if role == "Parameter" else None
    if item.encoding == "float":
        element = ET.SubElement(types, f"Float{role}Type", {"name": name, **bits})
        encoded = ET.SubElement(element, "FloatDataEncoding", {**bits, "encoding": "IEEE754_1985", **order})
    elif item.encoding in {"uint", "int"}:
        signed = item.encoding == "int"
        if item.enum:
            element = ET.SubElement(types, f"Enumerated{role}Type", {"name": name})
        elif member and member.polynomial:
            element = ET.SubElement(types, f"Float{role}Type", {"name": name})
        else:
            element = ET.SubElement(
                types, f"Integer{role}Type", {"name": name, "signed": str(signed).lower()}
            )
        encoding = "twosComplement" if signed else "unsigned"
        encoded = ET.SubElement(element, "IntegerDataEncoding", {**bits, "encoding": encoding, **order})
        if item.enum:
            listed = ET.SubElement(element, "EnumerationList")
            for value, label in item.enum.names.items():
                ET.SubElement(listed, "Enumeration", {"value": str(value), "label": label})
    elif item.encoding == "text":
        element = ET.SubElement(types, f"String{role}Type", {"name": name})
        encoded = ET.SubElement(element, "StringDataEncoding", {"encoding": "UTF-8"})
        size = ET.SubElement(encoded, "SizeInBits")
        ET.SubElement(ET.SubElement(size, "Fixed"), "FixedValue").text = str(item.bits)
        ET.SubElement(size, "TerminationChar").text = "00"
    else:
        element = ET.SubElement(types, f"Binary{role}Type", {"name": name})
        size = ET.SubElement(ET.SubElement(element, "BinaryDataEncoding"), "SizeInBits")
        ET.SubElement(size, "FixedValue").text = str(item.bits)
    if item.member and not item.enum and item.encoding in {"float", "uint", "int"}:
        _add_meaning(element, encoded, item.member, is_argument=member is None)


def _ends(limits: Range | None) -> dict[str, str]:
    pairs = zip(("minInclusive", "maxInclusive"), limits or (), strict=False)
    return {key: str(end) for key, end in pairs if end is not None}


def _add_meaning(element: ET.Element, encoded: ET.Element, member: Member, *, is_argument: bool) -> None:
    """Add the unit, calibration and limits of a type; an argument is sent uncalibrated."""
    if member.unit and not (is_argument and member.polynomial):
        element.insert(0, ET.Element("UnitSet"))
        ET.SubElement(element[0], "Unit").text = member.unit
    if is_argument:
        if (ends := _ends(member.red)) and not member.polynomial:
            ET.SubElement(ET.SubElement(element, "ValidRangeSet"), "ValidRange", ends)
        return
    if member.polynomial:
        calibrator = ET.SubElement(ET.SubElement(encoded, "DefaultCalibrator"), "PolynomialCalibrator")
        for exponent, coefficient in enumerate(member.polynomial):
            ET.SubElement(calibrator, "Term", {"coefficient": str(coefficient), "exponent": str(exponent)})
    if member.limits:
        alarms = ET.SubElement(ET.SubElement(element, "DefaultAlarm"), "StaticAlarmRanges")
        for tag, among in (("WarningRange", member.yellow), ("CriticalRange", member.red)):
            if limits := _ends(among):
                ET.SubElement(alarms, tag, limits)
