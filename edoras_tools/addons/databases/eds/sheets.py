"""Reads electronic data sheets: their packages become structs, the topics of their components packets.

1. All files are read together: a package may be in several files, and names may refer to other files.
2. A container that is based on one of cFE's headers is a packet. The component that has an interface with it
   gives its topic; a constraint of the container gives a command's function code.
3. Anything that cannot be read is noted with file and line; all the rest is read.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.databases.documents import Node, Notes, SheetError, has_root, parse_document
from edoras_tools.addons.databases.eds.parameters import Parameters
from edoras_tools.addons.databases.eds.types import DATA_TYPES, PACKET_HEADERS, Types
from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import Database
from edoras_tools.structs.shapes import ByteOrder, Key, StructLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_ROOTS: Final = ("PackageFile", "DataSheet", "DesignParameters")
_TOPICS: Final = {
    "command": (
        ("CFE_MISSION/TELECOMMAND_BASE_TOPICID", 0x1800),
        ("CFE_MISSION/GLOBAL_CMD_BASE_TOPICID", 0x1860),
    ),
    "telemetry": (
        ("CFE_MISSION/TELEMETRY_BASE_TOPICID", 0x0800),
        ("CFE_MISSION/GLOBAL_TLM_BASE_TOPICID", 0x0860),
    ),
}
"""First topics of one processor and of all processors, with the MsgIds of the first ones."""
_MOST_TOPICS: Final = 0x100
_MACHINES: Final[dict[str, ByteOrder]] = {"-mlittle-endian": "little", "-mbig-endian": "big"}
_DEFINE: Final = re.compile(r"-D\s*([\w/]+)=(.*)", re.ASCII)
_READ: Final = DATA_TYPES.union(
    ("Package", "Define", "DataTypeSet", "DimensionList", "Dimension", "EnumerationList", "Enumeration"),
    ("Range", "ValidRange", "SafeRange", "SafeRangeSet", "NominalRange", "NominalRangeSet", "MinMaxRange"),
    ("PrecisionRange", "ConstraintSet", "ValueConstraint", "EntryList", "TrailerEntryList", "PaddingEntry"),
    ("Entry", "LengthEntry", "FixedValueEntry", "ErrorControlEntry", "ListEntry", "Semantics", "Component"),
    ("IntegerDataEncoding", "FloatDataEncoding", "BooleanDataEncoding", "StringDataEncoding", "Interface"),
    ("PolynomialCalibrator", "Term", "ComponentSet", "RequiredInterfaceSet", "ProvidedInterfaceSet"),
    ("Implementation", "GenericTypeMapSet", "GenericTypeMap", "VariableSet", "Variable", "ParameterMapSet"),
    ("ParameterMap",),
)
_QUIET: Final = frozenset({"LongDescription", "Metadata", "DeclaredInterfaceSet", "PresentWhen"})
"""Elements that are not about packets, or have their own notes; all others not in ``_READ`` are noted."""


def is_sheet(data: bytes) -> bool:
    """Return whether a file is a data sheet, or has design parameters of one."""
    return has_root(data, *_ROOTS)


def read_sheets(files: Sequence[tuple[bytes, str]], flags: Sequence[str] = ()) -> StructLayout:
    """Make one layout of data sheets.

    Args:
        files: contents and name of each file.
        flags: flags as for a compiler: ``-DPACKAGE/NAME=VALUE``, a design parameter that overrides the
            sheets; ``-mlittle-endian`` or ``-mbig-endian``, for the C structs of such a machine.

    Raises:
        ConfigError: a file is not XML, a flag is not one of these, or no file has a data type.
    """
    machine: ByteOrder | None = None
    defines: dict[str, str] = {}
    for flag in flags:
        match = _DEFINE.fullmatch(flag)
        if match:
            defines[match[1] if "/" in match[1] else f"CFE_MISSION/{match[1]}"] = match[2].strip()
        elif flag in _MACHINES:
            machine = _MACHINES[flag]
        else:
            flags_read = f"-DPACKAGE/NAME=VALUE, {' and '.join(_MACHINES)}"
            raise ConfigError(f"--cflag: {flag!r} says nothing of data sheets; there are {flags_read}")
    sheets = _Sheets([parse_document(*file) for file in files], defines)
    layout = sheets.layout(machine or "big", machine=machine is not None)
    if machine is None and sheets.little:
        layout = sheets.layout("little", machine=False)
    return layout


SHEETS: Final = Database(is_sheet, lambda data, name: read_sheets([(data, name)]), read_sheets)


class _Sheets:
    """The packages of some sheets.

    Attributes:
        little: whether the last layout has more little-endian than big-endian numbers.
    """

    def __init__(self, roots: Sequence[Node], defines: dict[str, str]) -> None:
        self._notes = Notes()
        self._nodes: dict[str, Node] = {}
        self._components: list[tuple[str, Node]] = []
        self._file = roots[0].file
        self.little = False
        written: dict[str, str] = {}
        for root in roots:
            if root.tag not in _ROOTS:
                self._notes.add(root, f"{root.tag} is no data sheet")
                continue
            for package in root.inside("Package"):
                for item in package.inside("Define"):
                    key, value = f"{package.name}/{item.name}", item.attributes.get("value", "")
                    if written.setdefault(key, value) != value:
                        self._notes.add(
                            item, f"parameter {key} has another value in an earlier file, which holds"
                        )
                for item in (node for each in package.inside("DataTypeSet") for node in each.children):
                    name = f"{package.name}/{item.name}"
                    if item.tag in DATA_TYPES and self._nodes.setdefault(name, item) is not item:
                        self._notes.add(
                            item, f"type {name} is declared in {self._nodes[name]}, too, which holds"
                        )
                self._components += (
                    (package.name, item) for item in package.inside("ComponentSet", "Component")
                )
                self._notes.unread(package, _READ, _QUIET)
        self._parameters = Parameters({**written, **defines})

    def layout(self, order: ByteOrder, *, machine: bool) -> StructLayout:
        """Return all structs, with numbers of one byte order, and their packets."""
        before = Notes(self._notes)
        types = Types(self._nodes, self._parameters, order, machine=machine, note=self._notes.add)
        names: dict[str, str] = {}
        for name, node in self._nodes.items():
            try:
                data_type = types.find(name)
                if node.tag == "ContainerDataType":
                    names[name] = str(data_type.kind)
            except SheetError as error:
                self._notes.add(node, str(error))
        bindings: dict[Key, str] = {}
        for key, name, node in self._packets(types):
            if name in names and bindings.setdefault(key, names[name]) != names[name]:
                self._notes.add(node, f"{key} is {bindings[key]} already, not {names[name]}")
        self.little = types.orders["little"] > types.orders["big"]
        notes = self._notes.lines()
        self._notes = before
        if not types.structs:
            raise ConfigError(
                *(notes or (f"{self._file}: no container in it; name the sheets of packages, too",))
            )
        return StructLayout(types.structs, types.enums, bindings, order, origin=self._file, notes=notes)

    def _packets(self, types: Types) -> Iterator[tuple[Key, str, Node]]:
        """Yield the packets: key, the container in the packet, and the interface that determines it."""
        derived: dict[str, list[str]] = {}
        kinds: dict[str, str] = {}
        for name, node in self._nodes.items():
            if node.tag != "ContainerDataType":
                continue
            try:
                *_, last = bases = list(types.bases(name))
                kinds[name] = PACKET_HEADERS.get(last, "")
            except SheetError as error:
                self._notes.add(node, str(error))
                continue
            for base in bases[1:]:
                derived.setdefault(base, []).append(name)
        for package, component in self._components:
            for interface, topic, name in self._topics(types, package, component):
                kind = kinds.get(name, "")
                try:
                    msg_id = self._msg_id(topic, kind, name)
                    for item in derived.get(name, ()):
                        code = self._function_code(types, item)
                        if code is not None and kind == "command":
                            yield Key(msg_id, code), item, interface
                        elif code is not None or item not in derived:
                            self._notes.add(
                                self._nodes[item], f"{item} has no function code; its packets are {name}"
                            )
                    if name not in derived:
                        bare = kind == "command" and not types.find(name).bits
                        yield Key(msg_id, 0 if bare else None), name, interface
                except SheetError as error:
                    self._notes.add(interface, f"{component.name}.{interface.name} of {package}: {error}")

    def _topics(self, types: Types, package: str, component: Node) -> Iterator[tuple[Node, int, str]]:
        """Yield the interfaces of a component with a topic: its number, and the type of its messages."""
        initial = {
            item.name: item.attributes.get("initialValue", "")
            for item in component.inside("Implementation", "VariableSet", "Variable")
        }
        variables = {
            item.attributes.get("interface", ""): item.attributes.get("variableRef", "")
            for item in component.inside("Implementation", "ParameterMapSet", "ParameterMap")
            if item.attributes.get("parameter") == "TopicId"
        }
        for group in ("RequiredInterfaceSet", "ProvidedInterfaceSet"):
            for interface in component.inside(group, "Interface"):
                if interface.name not in variables:
                    continue
                for item in interface.inside("GenericTypeMapSet", "GenericTypeMap"):
                    try:
                        number = self._parameters.integer(initial.get(variables[interface.name], ""), package)
                        yield interface, number, types.full_name(item.attributes.get("type", ""), package)
                    except SheetError as error:
                        self._notes.add(interface, f"topic of {interface.name}: {error}")

    def _msg_id(self, topic: int, kind: str, name: str) -> int:
        """Return the MsgId of a topic, as cFE maps it on the first processor."""
        if not kind:
            raise SheetError(f"{name} is based on none of {', '.join(PACKET_HEADERS)}")
        for parameter, first in _TOPICS[kind]:
            place = topic - self._parameters.integer(f"${{{parameter}}}", "")
            if 0 <= place < _MOST_TOPICS:
                return first + place
        raise SheetError(f"topic {topic} is not one of {kind}")

    def _function_code(self, types: Types, name: str) -> int | None:
        """Return the function code from the constraints of a container and of its bases."""
        for base in types.bases(name):
            if base in PACKET_HEADERS:
                break
            for item in self._nodes[base].inside("ConstraintSet", "ValueConstraint"):
                if item.attributes.get("entry", "").rpartition(".")[2] == "FunctionCode":
                    code = self._parameters.integer(item.attributes.get("value", ""), base.rpartition("/")[0])
                    if not 0 <= code <= 0x7F:
                        raise SheetError(f"function code {code} of {name} is not 0 to 127")
                    return code
        return None
