"""C structs from debug information: DWARF 2 to 5 of an object file, a library or a program.

Needs pyelftools (``pip install 'edoras-tools[elf]'``).

``Maker`` turns entries into structs.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import tempfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.structs.messages import unique
from edoras_tools.structs.shapes import (
    BASIC,
    OPEN,
    Basic,
    BasicKind,
    ByteOrder,
    Enumeration,
    Key,
    Member,
    Struct,
    StructLayout,
)
from edoras_tools.words import did_you_mean

_Kept = TypeVar("_Kept", Struct, Enumeration)

_LARGEST_STRUCT: Final = 1 << 24
"""Size in bytes that a struct must stay below."""


class Maker:
    """Turns entries into structs, together with the structs and enumerations that they use.

    Attributes:
        structs: structs that were made, by name.
        enums: enumerations that they use, by name.
        warnings: one line for each type that is declared in more than one way.
    """

    def __init__(self, info: DebugInfo) -> None:
        self._info = info
        self.structs: dict[str, Struct] = {}
        self.enums: dict[str, Enumeration] = {}
        self.warnings: list[str] = []
        self._names: dict[int, str] = {}
        self._open: set[int] = set()

    def struct(self, die: Die, wish: str = "") -> str:
        """Make a struct and return its name."""
        if die.offset in self._names:
            return self._names[die.offset]
        if die.offset in self._open or len(self._open) > DEEPEST:
            raise ConfigError(f"{self._info.path}: {self._info.called(die) or 'a struct'} contains itself")
        self._open.add(die.offset)
        name = self._info.called(die) or wish or "Anonymous"
        listed = list(self._members(die, 0, name))
        # Only the last member may extend to the end of the packet; another array without a size is empty.
        members = [item for at, item in enumerate(listed, 1) if OPEN not in item.dims[at == len(listed) :]]
        struct = Struct(
            name,
            number_attribute(die, "DW_AT_byte_size"),
            tuple(members),
            union=STRUCTS[die.tag],
            header=self._info.header(die),
        )
        self._open.discard(die.offset)
        name = self._keep_struct(struct)
        self._names[die.offset] = name
        return name

    def check(self) -> None:
        """Check that every member lies inside its struct, and that no struct is too large.

        Raises:
            ConfigError: a member lies outside, so the debug information is damaged; or a struct is too large.
        """
        for item in self.structs.values():
            if item.size >= _LARGEST_STRUCT:
                text = f"{item.size} bytes are more than any packet holds; take a smaller struct"
                raise ConfigError(f"{self._info.path}: {item.name}: {text}")
            for member in item.members:
                width = (member.bit + member.bits + 7) // 8 or self._size(member) * prod(member.dims)
                if not 0 <= member.offset <= member.offset + width <= item.size:
                    raise ConfigError(f"{self._info.path}: {item.name}.{member.name} lies outside its struct")

    def _keep_struct(self, struct: Struct) -> str:
        """Add a struct; a different one of the same name gets a number."""
        name = self._keep(struct, self.structs, self.enums)
        if name != struct.name:
            self.warnings.append(
                f"{struct.name} is declared in more than one way; the other is called {name}"
            )
        return name

    @staticmethod
    def _keep(declared: _Kept, alike: dict[str, _Kept], others: Mapping[str, object]) -> str:
        """Keep a type under its name, or, if another type has that name, with a number; return the name."""
        name, copy = declared.name, 2
        while name in BASIC or name in others or alike.get(name) not in (None, replace(declared, name=name)):
            name, copy = f"{declared.name}_{copy}", copy + 1
        alike[name] = replace(declared, name=name)
        return name

    def _members(self, die: Die, base: int, owner: str) -> Iterator[Member]:
        names: set[str] = set()
        before: Member | None = None
        for item in children(die):
            if item.tag == "DW_TAG_inheritance":
                parent = underlying_type(type_of(item))
                inner = self._members(parent, base + offset_of(item), owner) if parent else iter(())
            elif item.tag == "DW_TAG_member" and "DW_AT_external" not in item.attributes:
                inner = self._member(item, base, owner)
            else:
                continue
            for part in inner:
                member = part if before is None or STRUCTS[die.tag] else self._behind(before, part)
                before = member
                name = unique(member.name, names)  # C++: a base class may have a member of that name
                yield replace(member, name=name) if name != member.name else member

    def _member(self, item: Die, base: int, owner: str) -> Iterator[Member]:
        name, at = name_of(item), base + offset_of(item)
        kind = underlying_type(type_of(item))
        if not name and kind is not None and kind.tag in STRUCTS:
            yield from self._members(kind, at, owner)  # C11: an anonymous struct's members
            return
        if not name:
            return
        member = self._typed(kind, Member(name, BASIC["byte"], at), f"{owner.removesuffix('_t')}_{name}")
        width = number_attribute(item, "DW_AT_bit_size")
        if width:
            size = number_attribute(item, "DW_AT_byte_size") or self._size(member)
            place = bit_place(item, at, base, size, width, self._info.byte_order)
            if member.dims:  # of __int128, which no ROS type holds: the bytes that contain part of it
                place = {"offset": place["offset"], "dims": ((place["bit"] + width + 7) // 8,)}
                yield replace(member, **place)
                return
            if member.type == BASIC["char"]:
                sign = DWARF_ENCODINGS.get(number_attribute(kind, "DW_AT_encoding"))
                member = replace(member, type=BASIC["int8" if sign is BasicKind.INT else "uint8"])
            whole = width == 8 * self._size(member) and not place["bit"]
            member = replace(member, **({"offset": place["offset"]} if whole else place))
        yield member

    def _behind(self, before: Member, member: Member) -> Member:
        """Return a member as a bit-field if it begins inside the last byte of the bit-field before it.

        Clang does not mark a bit-field as one if it is as wide as its type.
        """
        bit = 8 * before.offset + before.bit + before.bits
        whole = not before.bits or member.bits or member.dims or member.type in self.structs
        if whole or not 0 < bit - 8 * member.offset < 8:
            return member
        kind = BASIC["int8"] if member.type == BASIC["char"] else member.type
        return replace(member, type=kind, offset=bit // 8, bit=bit % 8, bits=8 * self._size(member))

    def extent(self, item: Die) -> int:
        """Return the size of a member in bytes."""
        members = list(self._member(item, 0, ""))
        return max((self._size(member) * prod(member.dims) for member in members), default=0)

    def _size(self, member: Member) -> int:
        if isinstance(member.type, Basic):
            return member.type.size
        if member.type in self.enums:
            return self.enums[member.type].basic.size
        return self.structs[member.type].size

    def _typed(self, die: Die | None, member: Member, wish: str) -> Member:
        """Return a member with the properties of its type."""
        if die is None:
            return replace(member, dims=(OPEN,))
        if die.tag in STRUCTS:
            return replace(member, type=self.struct(die, wish))
        if die.tag == "DW_TAG_array_type":
            inner = self._typed(underlying_type(type_of(die)), member, wish)
            return replace(inner, dims=(*dimensions(die), *inner.dims))
        if die.tag == "DW_TAG_enumeration_type":
            return replace(member, type=self._enumeration(die, wish))
        if die.tag in POINTERS:
            size = number_attribute(die, "DW_AT_byte_size") or self._info.pointer
            return replace(member, type=BASIC[f"uint{8 * size}"], base=16)
        if die.tag == "DW_TAG_base_type":
            return self._basic(die, member)
        size = number_attribute(die, "DW_AT_byte_size")
        return replace(member, dims=(size,))

    def _basic(self, die: Die, member: Member) -> Member:
        size, encoding = (
            number_attribute(die, "DW_AT_byte_size"),
            number_attribute(die, "DW_AT_encoding"),
        )
        if name_of(die) == "char" and size == 1:
            return replace(member, type=BASIC["char"])
        if encoding == 0x03 and size in {8, 16}:  # a complex number: real, then imaginary
            return replace(member, type=BASIC[f"float{4 * size}"], dims=(2,))
        kind = DWARF_ENCODINGS.get(encoding)
        basic = BASIC.get(str(Basic(kind, size))) if kind else None
        turned = BYTE_ORDERS.get(number_attribute(die, "DW_AT_endianity"), self._info.byte_order)
        if basic is None or turned != self._info.byte_order:
            # No ROS type holds it (e.g. a long double), or its byte order is not that of the file.
            return replace(member, type=BASIC["byte"], dims=(size,))
        return replace(member, type=basic)

    def _enumeration(self, die: Die, wish: str) -> str:
        size = number_attribute(die, "DW_AT_byte_size") or 4
        names: dict[int, str] = {}
        for item in children(die):
            if item.tag == "DW_TAG_enumerator" and name_of(item):
                names.setdefault(int(item.attributes["DW_AT_const_value"].value), name_of(item))
        under = underlying_type(type_of(die))
        signed = min(names, default=0) < 0
        if under is not None and "DW_AT_encoding" in under.attributes:
            signed = DWARF_ENCODINGS.get(number_attribute(under, "DW_AT_encoding")) is BasicKind.INT
        bits = 8 * size
        low = -(1 << (bits - 1)) if signed else 0
        names = {(value - low) % (1 << bits) + low: name for value, name in names.items()}
        basic = BASIC[f"{'' if signed else 'u'}int{bits}"]
        enumeration = Enumeration(self._info.called(die) or wish or "Enumeration", basic, names)
        return self._keep(enumeration, self.enums, self.structs)


STRUCTS: Final = {"DW_TAG_structure_type": False, "DW_TAG_class_type": False, "DW_TAG_union_type": True}
PLAIN: Final = frozenset(
    {
        *("DW_TAG_typedef", "DW_TAG_const_type", "DW_TAG_volatile_type", "DW_TAG_restrict_type"),
        *("DW_TAG_atomic_type", "DW_TAG_packed_type"),
    }
)
"""Typedefs and qualifiers of another type."""
_SCOPES: Final = frozenset({"DW_TAG_namespace", *STRUCTS})
POINTERS: Final = frozenset(
    {
        "DW_TAG_pointer_type",
        "DW_TAG_reference_type",
        "DW_TAG_rvalue_reference_type",
        "DW_TAG_ptr_to_member_type",
    }
)
DWARF_ENCODINGS: Final = {
    0x02: BasicKind.BOOL,
    0x04: BasicKind.FLOAT,
    0x05: BasicKind.INT,
    0x06: BasicKind.INT,
    0x07: BasicKind.UINT,
    0x08: BasicKind.UINT,
    0x10: BasicKind.UINT,
}
"""DW_ATE_boolean, float, signed, signed_char, unsigned, unsigned_char, UTF."""
BYTE_ORDERS: Final[Mapping[int, ByteOrder]] = {1: "big", 2: "little"}
"""DW_END_big, little: the byte order of a type that states one."""
_ADD: Final = 0x23
"""DW_OP_plus_uconst: the operation with which DWARF 2 states a member's offset."""
DEEPEST: Final = 64
_NO_NAME: Final = re.compile(r"\W|^(?=\d)", re.ASCII)

Die = Any
"""An entry of the debug information; pyelftools has no types."""


def underlying_type(die: Die | None) -> Die | None:
    """Return the type behind typedefs and qualifiers."""
    for _ in range(DEEPEST):
        if die is None or die.tag not in PLAIN:
            return die
        die = type_of(die)
    return None


def bit_place(item: Die, at: int, base: int, size: int, width: int, order: ByteOrder) -> dict[str, Any]:
    """Return the position of a bit-field, counted as in ``Member``."""
    if "DW_AT_data_bit_offset" in item.attributes:  # DWARF 4 and 5: from the start of the struct
        bit = 8 * base + number_attribute(item, "DW_AT_data_bit_offset")
    elif "DW_AT_bit_offset" in item.attributes:  # DWARF 2 and 3: from the unit's most significant bit
        offset = number_attribute(item, "DW_AT_bit_offset")
        if offset >= 1 << 63:
            offset -= 1 << 64
        bit = 8 * at + (8 * size - offset - width if order == "little" else offset)
    else:
        bit = 8 * at
    return {"offset": bit // 8, "bit": bit % 8, "bits": width}


def children(die: Die) -> Iterator[Die]:
    """Yield the entries inside an entry.

    Raises:
        ValueError: they form a cycle, as in damaged files, where pyelftools would never end.
    """
    for item in die.iter_children():
        sibling = item.attributes.get("DW_AT_sibling")
        yield item
        if sibling is not None:
            base = 0 if sibling.form == "DW_FORM_ref_addr" else item.cu.cu_offset
            if base + sibling.value <= item.offset:
                raise ValueError("its entries go in a circle")
        elif item.has_children:
            for _ in children(item):  # up to its end; pyelftools would search for it without a limit
                pass


def types_in(die: Die, depth: int) -> Iterator[Die]:
    """Yield the types inside an entry, including those in name spaces."""
    for item in children(die):
        if item.tag == "DW_TAG_typedef" or item.tag in STRUCTS:
            yield item
        if item.tag in _SCOPES and depth < DEEPEST:
            yield from types_in(item, depth + 1)


def members_of(die: Die) -> list[Die]:
    """Return the members of a struct."""
    return [item for item in children(die) if item.tag == "DW_TAG_member"]


def name_of(die: Die) -> str:
    """Return an entry's name as a C identifier; empty if it has none."""
    entry = die.attributes.get("DW_AT_name")
    return spelled(entry.value.decode(errors="replace")) if entry else ""


def spelled(name: str) -> str:
    """Return a name as a C identifier: ``Tp<int>`` is ``Tp_int_``."""
    return _NO_NAME.sub("_", name)


def type_of(die: Die) -> Die | None:
    """Return the entry of an entry's type."""
    return die.get_DIE_from_attribute("DW_AT_type") if "DW_AT_type" in die.attributes else None


def number_attribute(die: Die, attribute: str) -> int:
    """Return an attribute that is a number; 0 where there is none."""
    entry = die.attributes.get(attribute)
    return entry.value if entry is not None and isinstance(entry.value, int) else 0


def offset_of(item: Die) -> int:
    """Return a member's offset: a number, or the one expression that DWARF 2 uses.

    Raises:
        ValueError: it is another expression.
    """
    entry = item.attributes.get("DW_AT_data_member_location")
    if entry is None:
        return 0
    if isinstance(entry.value, int):
        return entry.value
    operation, *operand = entry.value
    if operation != _ADD:
        raise ValueError(f"the place of {name_of(item) or 'a virtual base class'} is computed at run time")
    value = 0
    for index, octet in enumerate(operand):
        value |= (octet & 0x7F) << (7 * index)
    return value


def dimensions(die: Die) -> Iterator[int]:
    """Yield the dimensions of an array, outermost first."""
    for item in children(die):
        if item.tag != "DW_TAG_subrange_type":
            continue
        if "DW_AT_count" in item.attributes:
            yield number_attribute(item, "DW_AT_count")
        elif "DW_AT_upper_bound" in item.attributes:
            bound = item.attributes["DW_AT_upper_bound"].value
            # The upper bound of a zero-length array is -1, written as the largest number.
            size = bound + 1 if isinstance(bound, int) else OPEN
            yield size if size < 1 << 31 else OPEN
        else:
            yield OPEN


_CLASSES: Final = frozenset({".hh", ".hpp", ".hxx", ".cc", ".cpp", ".cxx"})
SOURCE_SUFFIXES: Final = frozenset({".h", ".c"}) | _CLASSES
"""File suffixes of C and C++ headers and sources."""
_UNIT: Final = "typedef char edoras_unit;\n"
"""Compiled after the header, so that a header without types also has debug information."""
_PATIENCE_S: Final = 120


def compiled(source: Path, include: Sequence[Path], flags: Sequence[str]) -> DebugInfo:
    """Compile a header for its debug information alone: every type in it, used or not.

    The compiler is ``$CC`` with its options, or ``cc``; a cross compiler gives the sizes and byte order of
    its target.

    Args:
        source: the header, or a source file that includes headers.
        include: folders of the headers that it includes.
        flags: further compiler options, e.g. ``-m32`` or ``-DX=1``.

    Raises:
        ConfigError: there is no compiler, or it fails; with the first line of its output.
    """
    try:
        compiler = shlex.split(os.environ.get("CC", "cc")) or ["cc"]
    except ValueError as error:
        raise ConfigError(f"CC: {os.environ['CC']!r} is not a command: {error}") from error
    if not source.is_file():
        raise ConfigError(f"{source}: no such file; give a C header, or an ELF file")
    with tempfile.TemporaryDirectory(prefix="edoras-") as folder:
        unit = Path(folder, "structs.cc" if source.suffix.lower() in _CLASSES else "structs.c")
        unit.write_text(_UNIT, encoding="utf-8")
        target = Path(folder, "structs.o")
        command = [*compiler, "-g", "-gdwarf-4", "-fno-eliminate-unused-debug-types", *flags]
        command += [*(f"-I{path}" for path in include), "-include", str(source.resolve())]
        try:
            result = subprocess.run(  # noqa: S603  the user's own compiler, with the user's own options
                [*command, "-c", str(unit), "-o", str(target)],
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=_PATIENCE_S,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            why = getattr(error, "strerror", None) or "takes too long"
            raise ConfigError(
                f"{compiler[0]}: {why}; install a C compiler or name one in CC, or give an ELF file"
            ) from error
        if result.returncode:
            lines = result.stderr.splitlines() or ["no word from the compiler"]
            first = next((line for line in lines if "error" in line), lines[0])
            raise ConfigError(f"{source}: does not compile: {first.strip()}")
        if not target.exists():
            raise ConfigError(f"{source}: the compiler makes no object file; look at --cflag and CC")
        return DebugInfo(target, source)


_HEADERS: Final = ("telemetryheader", "commandheader", "tlmheader", "cmdheader", "tlmhdr", "cmdhdr")
"""Names of cFE's headers, and of members that hold one, in all versions; lower case, without ``_``."""


class Listed(NamedTuple):
    """A struct or union that a file describes.

    Attributes:
        name: name of its typedef if it has one, else its own tag.
        size: size in bytes.
        header: size in bytes of the cFE header at its beginning; 0 without one.
        members: number of members.
    """

    name: str
    size: int
    header: int
    members: int


def _shape(die: Die) -> tuple[object, ...]:
    """Return the properties by which structs of one name differ."""
    return number_attribute(die, "DW_AT_byte_size"), *(
        (name_of(item), offset_of(item)) for item in members_of(die)
    )


def struct_name(name: str, names: Collection[str], origin: object, otherwise: str) -> str:
    """Return the name that a struct has among others; ``_t`` may be absent, or one too many.

    Args:
        origin: file that has the structs, for the error.
        otherwise: advice if no name is similar.

    Raises:
        ConfigError: there is none.
    """
    for spelling in (name, f"{name}_t", name.removesuffix("_t"), spelled(name)):
        if spelling in names:
            return spelling
    raise ConfigError(f"{origin}: no struct {name!r}; {did_you_mean(name, names) or otherwise}")


class DebugInfo:
    """The types that a file's debug information describes.

    Args:
        path: an ELF file: ``.o``, ``.so`` or a program.
        source: name of the file in messages, if not the path.

    Attributes:
        path: name of the file in messages.
        byte_order: byte order of the machine.
        warnings: one line for each type with two different descriptions.

    Raises:
        ConfigError: the file cannot be read, is not ELF, or was stripped.
    """

    def __init__(self, path: str | os.PathLike[str], source: Path | None = None) -> None:
        try:
            from elftools.common.exceptions import DWARFError, ELFError
            from elftools.elf.elffile import ELFFile
        except ImportError:
            raise ConfigError(
                "debug information is read by pyelftools: pip install 'edoras-tools[elf]'"
            ) from None
        self.path = source or Path(path)
        self.warnings: list[str] = []
        self._broken = (ELFError, DWARFError, ValueError, LookupError, AttributeError, TypeError, zlib.error)
        try:
            # Kept in memory: later lookups read it, and the file can be closed.
            data = Path(path).read_bytes()
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read ({error.strerror}); give an ELF file") from error
        if data[:4] != b"\x7fELF":
            raise ConfigError(f"{self.path}: no ELF file; give a .o, a .so or a program compiled with -g")

        with self._reading():
            elf = ELFFile(BytesIO(data))
            self.byte_order: ByteOrder = "little" if elf.little_endian else "big"
            self.pointer = elf.elfclass // 8
            if sum(item.name == ".debug_info" for item in elf.iter_sections()) > 1:
                why = "its types are in sections of their own; compile it without -fdebug-types-section"
                raise ConfigError(f"{self.path}: {why}")
            if elf.get_section_by_name(".debug_info") is None:
                self._stripped(elf)
            patched = relocated(elf, data)
            whole = elf if patched is None else ELFFile(BytesIO(patched))
            self._index(whole.get_dwarf_info(relocate_dwarf_sections=patched is None))

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Turn any exception from damaged information into an error of one line."""
        try:
            yield
        except (*self._broken, RuntimeError, AssertionError, OverflowError, MemoryError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise ConfigError(f"{self.path}: its debug information cannot be read: {reason}") from error

    def _stripped(self, elf: Any) -> None:
        if elf.get_section_by_name(".gnu_debuglink") is not None:
            why = "its debug information was split off into another file; give that one"
        elif elf.get_section_by_name(".zdebug_info") is not None:
            why = "its debug information is compressed in an old way; compile it with -gz=zlib or no -gz"
        elif elf.get_section_by_name(".debug_info.dwo") is not None:
            why = "it is one half of split debug information; compile it without -gsplit-dwarf"
        elif any(item.name.startswith(".gnu.debuglto_") for item in elf.iter_sections()):
            why = "its debug information is not linked yet; compile it without -flto, or give the program"
        else:
            why = "it has no debug information, was stripped or compiled without -g; compile it with -g"
        raise ConfigError(f"{self.path}: {why}")

    def _index(self, info: Any) -> None:
        """List the names of types; their members are read on demand."""
        self._found: dict[str, Die] = {}
        self._named: dict[int, str] = {}
        self._others: dict[str, list[Die]] = {}  # other structs of the same name
        tags: dict[str, Die] = {}
        for unit in info.iter_CUs():
            if unit.header.get("unit_type") == "DW_UT_type" or info.debug_types_sec is not None:
                raise ConfigError(
                    f"{self.path}: its types are in units of their own; compile it without "
                    "-fdebug-types-section"
                )
            top = unit.get_top_DIE()
            name = top.attributes.get("DW_AT_dwo_name") or top.attributes.get("DW_AT_GNU_dwo_name")
            if name is not None:
                raise ConfigError(
                    f"{self.path}: its debug information is in {name.value.decode(errors='replace')}; "
                    "compile it without -gsplit-dwarf"
                )
            for die in types_in(top, 0):
                name = name_of(die)
                if die.tag == "DW_TAG_typedef":
                    die_type = underlying_type(type_of(die))
                    if name and die_type is not None and die_type.tag == "DW_TAG_enumeration_type":
                        self._named.setdefault(die_type.offset, name)
                    elif name and die_type is not None and die_type.tag in STRUCTS:
                        self._named.setdefault(die_type.offset, name)
                        self._found_as(name, die_type, self._found)
                elif die.tag in STRUCTS and name and "DW_AT_declaration" not in die.attributes:
                    self._found_as(name, die, tags)
        for name, die in tags.items():
            self._found.setdefault(self._named.setdefault(die.offset, name), die)

    def _found_as(self, name: str, die: Die, among: dict[str, Die]) -> None:
        if name not in among:
            among[name] = die
        elif among[name].offset != die.offset:
            self._others.setdefault(name, []).append(die)

    def list(self) -> list[Listed]:
        """Return every struct and union that has a name, sorted by name.

        Raises:
            ConfigError: the debug information is damaged.
        """
        with self._reading():
            return [
                Listed(
                    name,
                    number_attribute(die, "DW_AT_byte_size"),
                    self.header(die),
                    len(members_of(die)),
                )
                for name, die in sorted(self._found.items())
                if not name.startswith("__")  # those of the C library
            ]

    def bound(self) -> dict[str, str]:
        """Return nothing: debug information does not say which packets contain structs."""
        return {}

    def layout(
        self, names: Iterable[str], bindings: Mapping[Key, str], package: str | None
    ) -> tuple[StructLayout, dict[str, str]]:
        """Return structs with all that they use, and the names of the requested ones in the result.

        Args:
            names: names of structs; the tag of a typedef, or a name without ``_t``, is accepted, too.
            bindings: packets that contain some of them.
            package: ROS package of their messages; None: the usual one.

        Raises:
            ConfigError: a struct is not found, or cannot be read.
        """
        maker = Maker(self)
        with self._reading():
            dies = {name: self.find(name) for name in [*names, *bindings.values()]}
            called = {name: maker.struct(die) for name, die in dies.items()}
            maker.check()
            for die in dict.fromkeys(dies.values()):
                self._told_apart(die)
        self.warnings += maker.warnings
        bound = {key: called[name] for key, name in bindings.items()}
        layout = StructLayout(maker.structs, maker.enums, bound, self.byte_order, origin=str(self.path))
        return replace(layout, package=package or layout.package), called

    def _told_apart(self, die: Die) -> None:
        """Warn where a named struct differs between compilation units."""
        name, shape = self.called(die), _shape(die)
        if any(_shape(other) != shape for other in self._others.get(name, ())):
            size = number_attribute(die, "DW_AT_byte_size")
            self.warnings.append(
                f"{name} is declared in more than one way; the first is taken, of {size} bytes: check it, or "
                "give the object file that has the right one"
            )

    def find(self, name: str) -> Die:
        """Return the entry of a struct.

        Raises:
            ConfigError: no struct has that name; the error lists similar names.
        """
        return self._found[
            struct_name(name, self._found, self.path, f"'edoras structs {self.path}' lists all")
        ]

    def called(self, die: Die) -> str:
        """Return the name of a struct or an enumeration; empty if it has none."""
        return self._named.get(die.offset) or name_of(die)

    def header(self, die: Die) -> int:
        """Return the size in bytes of the cFE header at the beginning of a struct; 0 without one."""
        members = members_of(die)
        if not members or die.tag not in STRUCTS or STRUCTS[die.tag] or offset_of(members[0]):
            return 0
        first = members[0]
        kind = type_of(first)
        words = [name_of(first)]
        for _ in range(DEEPEST):
            if kind is None or kind.tag not in {*PLAIN, *STRUCTS, "DW_TAG_array_type"}:
                break
            words.append(name_of(kind))
            kind = type_of(kind) if kind.tag in PLAIN else None
        if not any(word.replace("_", "").lower().removesuffix("t").endswith(_HEADERS) for word in words):
            return 0
        return Maker(self).extent(first)


_WORDS: Final = {
    "EM_PPC": {1: 4, 24: 4},
    "EM_SPARC": {3: 4, 23: 4, 32: 8, 54: 8},
    "EM_SPARC32PLUS": {3: 4, 23: 4},
    "EM_SPARCV9": {3: 4, 23: 4, 32: 8, 54: 8},
    "EM_68K": {1: 4},
    "EM_MICROBLAZE": {1: 4},
    "EM_RISCV": {1: 4, 2: 8},
}
"""Relocation types that write a whole word (R_PPC_ADDR32, R_SPARC_UA32 and so on), with its size in bytes,
by machine; the other types belong to code addresses, which have nothing to do with types."""


def relocated(elf: Any, data: bytes) -> bytes | None:
    """Return the file with the relocations of its debug sections applied; None if pyelftools can apply them.

    Args:
        elf: the file, as pyelftools opened it.
        data: the file's bytes.
    """
    words = _WORDS.get(elf["e_machine"])
    if words is None:
        return None
    out = bytearray(data)
    order = "little" if elf.little_endian else "big"
    for section in elf.iter_sections("SHT_RELA"):
        target = elf.get_section(section["sh_info"])
        if not target.name.startswith(".debug_"):
            continue
        symbols = elf.get_section(section["sh_link"])
        for item in section.iter_relocations():
            size = words.get(item["r_info_type"])
            at = item["r_offset"]
            if size is None or at + size > target["sh_size"]:
                continue
            value = symbols.get_symbol(item["r_info_sym"])["st_value"] + item["r_addend"]
            place = target["sh_offset"] + at
            out[place : place + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, order)
    return bytes(out)
