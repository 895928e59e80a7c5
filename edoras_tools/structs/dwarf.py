"""C structs from debug information: DWARF 2 to 5 of an object file, a library or a program.

Needs pyelftools (``pip install 'edoras-tools[elf]'``).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.structs.relocation import relocated
from edoras_tools.structs.shapes import (
    BASIC,
    OPEN,
    Basic,
    ByteOrder,
    Enumeration,
    Key,
    Kind,
    Layout,
    Member,
    Struct,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Iterator, Mapping

_STRUCTS: Final = {
    "DW_TAG_structure_type": False,
    "DW_TAG_class_type": False,
    "DW_TAG_union_type": True,
}
_PLAIN: Final = frozenset(
    {
        *("DW_TAG_typedef", "DW_TAG_const_type", "DW_TAG_volatile_type", "DW_TAG_restrict_type"),
        *("DW_TAG_atomic_type", "DW_TAG_packed_type"),
    }
)
"""Names for, and qualities of, another type."""
_SCOPES: Final = frozenset({"DW_TAG_namespace", *_STRUCTS})
_POINTERS: Final = frozenset(
    {
        "DW_TAG_pointer_type",
        "DW_TAG_reference_type",
        "DW_TAG_rvalue_reference_type",
        "DW_TAG_ptr_to_member_type",
    }
)
_ENCODINGS: Final = {
    0x02: Kind.BOOL,
    0x04: Kind.FLOAT,
    0x05: Kind.INT,
    0x06: Kind.INT,
    0x07: Kind.UINT,
    0x08: Kind.UINT,
    0x10: Kind.UINT,
}
"""DW_ATE_boolean, float, signed, signed_char, unsigned, unsigned_char, UTF."""
_ADD: Final = 0x23
"""DW_OP_plus_uconst: how DWARF 2 writes a member's place."""
_HEADERS: Final = ("telemetryheader", "commandheader", "tlmheader", "cmdheader", "tlmhdr", "cmdhdr")
"""What cFE's headers and members that hold one are called in its versions: small letters, without ``_``."""
_DEEPEST: Final = 64

Die = Any
"""An entry of the debug information; pyelftools has no types."""


class Listed:
    """A struct or union that a file describes.

    Attributes:
        name: a typedef's where it has one, else its own tag.
        size: in bytes.
        header: bytes of the cFE header that it begins with; 0 where it begins with none.
        members: how many it has.
    """

    __slots__ = ("header", "members", "name", "size")

    def __init__(self, name: str, size: int, header: int, members: int) -> None:
        self.name = name
        self.size = size
        self.header = header
        self.members = members


class DebugInfo:
    """The types that a file's debug information describes.

    Args:
        path: an ELF file: ``.o``, ``.so`` or a program.

    Attributes:
        path: as given.
        byte_order: of the machine.
        warnings: one line each, of what is described twice and not alike.

    Raises:
        ConfigError: the file cannot be read, is no ELF, or was stripped.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            from elftools.common.exceptions import DWARFError, ELFError
            from elftools.elf.elffile import ELFFile
        except ImportError:
            raise ConfigError(
                "debug information is read by pyelftools: pip install 'edoras-tools[elf]'"
            ) from None
        self.path = Path(path)
        self.warnings: list[str] = []
        self._broken = (ELFError, DWARFError, ValueError, KeyError, IndexError, AttributeError, TypeError)
        try:
            # Held in memory: what is asked for later is looked up there, and nothing stays open.
            data = self.path.read_bytes()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror}); give an ELF file") from error
        if data[:4] != b"\x7fELF":
            raise ConfigError(f"{path}: no ELF file; give a .o, a .so or a program compiled with -g")
        from io import BytesIO

        try:
            elf = ELFFile(BytesIO(data))
            self.byte_order: ByteOrder = "little" if elf.little_endian else "big"
            self._pointer = elf.elfclass // 8
            if sum(item.name == ".debug_info" for item in elf.iter_sections()) > 1:
                why = "its types are in sections of their own; compile it without -fdebug-types-section"
                raise ConfigError(f"{path}: {why}")
            if not elf.has_dwarf_info() or elf.get_section_by_name(".debug_info") is None:
                self._stripped(elf)
            patched = relocated(elf, data)
            dwarf = ELFFile(BytesIO(patched)).get_dwarf_info(False) if patched else elf.get_dwarf_info()
            self._index(dwarf)
        except (*self._broken, NotImplementedError, RecursionError, AssertionError, OverflowError) as error:
            if isinstance(error, ConfigError):
                raise
            what = str(error).partition("\n")[0] or type(error).__name__
            raise ConfigError(f"{path}: its debug information cannot be read: {what}") from error

    def _stripped(self, elf: Any) -> None:
        if elf.get_section_by_name(".gnu_debuglink") is not None:
            why = "its debug information was split off into another file; give that one"
        else:
            why = "it has no debug information, was stripped or compiled without -g; compile it with -g"
        raise ConfigError(f"{self.path}: {why}")

    def _index(self, dwarf: Any) -> None:
        """List the names of types; what they are made of is read when it is asked for."""
        self._found: dict[str, Die] = {}
        self._named: dict[int, str] = {}
        tags: dict[str, Die] = {}
        for unit in dwarf.iter_CUs():
            if unit.header.get("unit_type") == "DW_UT_type" or dwarf.debug_types_sec is not None:
                raise ConfigError(
                    f"{self.path}: its types are in units of their own; compile it without "
                    "-fdebug-types-section"
                )
            top = unit.get_top_DIE()
            if "DW_AT_GNU_dwo_name" in top.attributes or "DW_AT_dwo_name" in top.attributes:
                name = top.attributes.get("DW_AT_dwo_name") or top.attributes["DW_AT_GNU_dwo_name"]
                raise ConfigError(
                    f"{self.path}: its debug information is in {name.value.decode(errors='replace')}; "
                    "compile it without -gsplit-dwarf"
                )
            for die in _types(top, 0):
                name = _name(die)
                if die.tag == "DW_TAG_typedef":
                    made = self._strip(_type(die))
                    if name and made is not None and made.tag == "DW_TAG_enumeration_type":
                        self._named.setdefault(made.offset, name)
                    elif name and made is not None and made.tag in _STRUCTS:
                        self._named.setdefault(made.offset, name)
                        self._found.setdefault(name, made)
                elif die.tag in _STRUCTS and name and "DW_AT_declaration" not in die.attributes:
                    tags.setdefault(name, die)
        for name, die in tags.items():
            self._found.setdefault(self._named.setdefault(die.offset, name), die)

    @staticmethod
    def _strip(die: Die | None) -> Die | None:
        """Return the type behind typedefs and qualifiers."""
        for _ in range(_DEEPEST):
            if die is None or die.tag not in _PLAIN:
                return die
            die = _type(die)
        return None

    def list(self) -> list[Listed]:
        """Return every struct and union that has a name, in the order of their names."""
        return [
            Listed(name, _number(die, "DW_AT_byte_size"), self._header(die), len(_members(die)))
            for name, die in sorted(self._found.items())
            if not name.startswith("__")  # the C library's own
        ]

    def __contains__(self, name: str) -> bool:
        return name in self._found

    def names(self) -> Iterable[str]:
        """Return the names that there are."""
        return self._found

    def layout(self, names: Iterable[str], bindings: Mapping[Key, str], package: str) -> Layout:
        """Return some structs and all that they use.

        Args:
            names: of structs; a tag does for a typedef, and a name without ``_t``.
            bindings: the packets that some of them lie in.
            package: ROS package of their messages.

        Raises:
            ConfigError: there is no such struct, or it cannot be read.
        """
        made = _Maker(self)
        try:
            called = {name: made.struct(self.find(name)) for name in [*names, *bindings.values()]}
        except RecursionError:
            raise ConfigError(f"{self.path}: its types are nested too deeply") from None
        except self._broken as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{self.path}: its debug information is damaged: {error}") from error
        self.warnings += made.warnings
        bound = {key: called[name] for key, name in bindings.items()}
        return Layout(made.structs, made.enums, bound, self.byte_order, package, str(self.path))

    def find(self, name: str) -> Die:
        """Return the entry of a struct.

        Raises:
            ConfigError: there is none of that name; says which are like it.
        """
        for known in (name, f"{name}_t", name.removesuffix("_t")):
            if known in self._found:
                return self._found[known]
        from difflib import get_close_matches

        lower = {item.lower(): item for item in self._found}
        near = [lower[item] for item in get_close_matches(name.lower(), lower, 3)]
        hint = f"did you mean {' or '.join(near)}?" if near else f"'edoras structs {self.path}' lists all"
        raise ConfigError(f"{self.path}: no struct {name!r}; {hint}")

    def called(self, die: Die) -> str:
        """Return the name of a struct or an enumeration; nothing where it has none."""
        return self._named.get(die.offset) or _name(die)

    def _header(self, die: Die) -> int:
        """Return the size of the cFE header that a struct begins with."""
        members = _members(die)
        if not members or die.tag not in _STRUCTS or _STRUCTS[die.tag] or _place(members[0]):
            return 0
        first = members[0]
        kind = _type(first)
        words = [_name(first)]
        while kind is not None and kind.tag in {*_PLAIN, *_STRUCTS, "DW_TAG_array_type"}:
            words.append(_name(kind))
            kind = _type(kind) if kind.tag in _PLAIN else None
        if not any(word.replace("_", "").lower().removesuffix("t").endswith(_HEADERS) for word in words):
            return 0
        return _Maker(self).extent(first)

    header = _header


class _Maker:
    """Turns entries into structs, and those that they use."""

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
        if die.offset in self._open or len(self._open) > _DEEPEST:
            raise ConfigError(f"{self._info.path}: {self._info.called(die) or 'a struct'} contains itself")
        self._open.add(die.offset)
        name = self._info.called(die) or wish or "Anonymous"
        members = list(self._members(die, 0))
        made = Struct(
            name,
            _number(die, "DW_AT_byte_size"),
            tuple(members),
            union=_STRUCTS[die.tag],
            header=self._info.header(die),
        )
        self._open.discard(die.offset)
        name = self._kept(made)
        self._names[die.offset] = name
        return name

    def _kept(self, made: Struct) -> str:
        """Keep a struct; one of the same name that is not alike is given a number."""
        from dataclasses import replace

        name, number = made.name, 2
        while name in self.structs and self.structs[name] != replace(made, name=name):
            name, number = f"{made.name}_{number}", number + 1
        if name != made.name:
            self.warnings.append(f"{made.name} is declared in more than one way; the other is called {name}")
        self.structs[name] = replace(made, name=name)
        return name

    def _members(self, die: Die, base: int) -> Iterator[Member]:
        taken: set[str] = set()
        for item in die.iter_children():
            if item.tag == "DW_TAG_inheritance":
                parent = self._info._strip(_type(item))  # noqa: SLF001  of one kind
                inner = self._members(parent, base + _place(item)) if parent is not None else iter(())
            elif item.tag == "DW_TAG_member" and "DW_AT_external" not in item.attributes:
                inner = self._member(item, base, self._info.called(die))
            else:
                continue
            for member in inner:
                if member.name not in taken:
                    taken.add(member.name)
                    yield member

    def _member(self, item: Die, base: int, owner: str) -> Iterator[Member]:
        from dataclasses import replace

        name, at = _name(item), base + _place(item)
        kind = self._info._strip(_type(item))  # noqa: SLF001  of one kind
        if not name and kind is not None and kind.tag in _STRUCTS:
            yield from self._members(kind, at)  # C11: its members are those of the struct around it
            return
        if not name:
            return
        member = self._typed(kind, Member(name, BASIC["byte"], at), f"{owner.removesuffix('_t')}_{name}")
        width = _number(item, "DW_AT_bit_size")
        if width:
            size = _number(item, "DW_AT_byte_size") or self._size(member)
            found = _bit_place(item, at, base, size, width, self._info.byte_order)
            plain = width == 8 * self._size(member) and not found["bit"]
            member = replace(member, **({"offset": found["offset"]} if plain else found))
        yield member

    def extent(self, item: Die) -> int:
        """Return the bytes of a member."""
        found = list(self._member(item, 0, ""))
        return max((self._size(member) * _count(member) for member in found), default=0)

    def _size(self, member: Member) -> int:
        if isinstance(member.type, Basic):
            return member.type.size
        if member.type in self.enums:
            return self.enums[member.type].basic.size
        return self.structs[member.type].size

    def _typed(self, die: Die | None, member: Member, wish: str) -> Member:
        """Return a member with what its type says."""
        from dataclasses import replace

        if die is None:
            return replace(member, dims=(OPEN,))
        if die.tag in _STRUCTS:
            return replace(member, type=self.struct(die, wish))
        if die.tag == "DW_TAG_array_type":
            inner = self._typed(self._info._strip(_type(die)), member, wish)  # noqa: SLF001  of one kind
            return replace(inner, dims=(*_dimensions(die), *inner.dims))
        if die.tag == "DW_TAG_enumeration_type":
            return replace(member, type=self._enumeration(die, wish))
        if die.tag in _POINTERS:
            size = _number(die, "DW_AT_byte_size") or self._info._pointer  # noqa: SLF001  of one kind
            return replace(member, type=BASIC[f"uint{8 * size}"], base=16)
        if die.tag == "DW_TAG_base_type":
            return self._basic(die, member)
        size = _number(die, "DW_AT_byte_size")
        return replace(member, dims=(size,))

    @staticmethod
    def _basic(die: Die, member: Member) -> Member:
        from dataclasses import replace

        size, encoding = _number(die, "DW_AT_byte_size"), _number(die, "DW_AT_encoding")
        if _name(die) == "char" and size == 1:
            return replace(member, type=BASIC["char"])
        if encoding == 0x03 and size in {8, 16}:  # a complex number: real, then imaginary
            return replace(member, type=BASIC[f"float{4 * size}"], dims=(2,))
        kind = _ENCODINGS.get(encoding)
        found = BASIC.get(str(Basic(kind, size))) if kind else None
        if found is None:  # as a long double: no ROS type holds it
            return replace(member, type=BASIC["byte"], dims=(size,))
        return replace(member, type=found)

    def _enumeration(self, die: Die, wish: str) -> str:
        from dataclasses import replace

        size = _number(die, "DW_AT_byte_size") or 4
        names: dict[int, str] = {}
        for item in die.iter_children():
            if item.tag == "DW_TAG_enumerator":
                names.setdefault(int(item.attributes["DW_AT_const_value"].value), _name(item))
        under = self._info._strip(_type(die))  # noqa: SLF001  of one kind
        signed = min(names, default=0) < 0
        if under is not None and "DW_AT_encoding" in under.attributes:
            signed = _ENCODINGS.get(_number(under, "DW_AT_encoding")) is Kind.INT
        bits = 8 * size
        if not signed:
            names = {value & ((1 << bits) - 1): name for value, name in names.items()}
        basic = BASIC[f"{'' if signed else 'u'}int{bits}"]
        made = Enumeration(self._info.called(die) or wish or "Enumeration", basic, names)
        name, number = made.name, 2
        while (name in self.enums and self.enums[name] != replace(made, name=name)) or name in self.structs:
            name, number = f"{made.name}_{number}", number + 1
        self.enums[name] = replace(made, name=name)
        return name


def _count(member: Member) -> int:
    count = 1
    for size in member.dims:
        count *= size
    return count


def _bit_place(item: Die, at: int, base: int, size: int, width: int, order: ByteOrder) -> dict[str, Any]:
    """Return where a bit-field lies, counted as ``Member`` says."""
    if "DW_AT_data_bit_offset" in item.attributes:  # DWARF 4 and 5: from the start of the struct
        bit = 8 * base + _number(item, "DW_AT_data_bit_offset")
    elif "DW_AT_bit_offset" in item.attributes:  # DWARF 2 and 3: from the unit's most significant bit
        offset = _number(item, "DW_AT_bit_offset")
        if offset >= 1 << 63:
            offset -= 1 << 64
        bit = 8 * at + (8 * size - offset - width if order == "little" else offset)
    else:
        bit = 8 * at
    return {"offset": bit // 8, "bit": bit % 8, "bits": width}


def _types(die: Die, depth: int) -> Iterator[Die]:
    """Yield the types inside an entry, those in name spaces too."""
    for item in die.iter_children():
        if item.tag == "DW_TAG_typedef" or item.tag in _STRUCTS:
            yield item
        if item.tag in _SCOPES and depth < _DEEPEST:
            yield from _types(item, depth + 1)


def _members(die: Die) -> list[Die]:
    return [item for item in die.iter_children() if item.tag == "DW_TAG_member"]


def _name(die: Die) -> str:
    found = die.attributes.get("DW_AT_name")
    return found.value.decode(errors="replace") if found else ""


def _type(die: Die) -> Die | None:
    return die.get_DIE_from_attribute("DW_AT_type") if "DW_AT_type" in die.attributes else None


def _number(die: Die, attribute: str) -> int:
    found = die.attributes.get(attribute)
    return found.value if found is not None and isinstance(found.value, int) else 0


def _place(item: Die) -> int:
    """Return a member's offset: a number, or the one expression that DWARF 2 uses."""
    found = item.attributes.get("DW_AT_data_member_location")
    if found is None:
        return 0
    if isinstance(found.value, int):
        return found.value
    operation, *operand = found.value
    if operation != _ADD:
        raise ConfigError(f"{_name(item)}: its place is computed at run time")
    value = 0
    for index, octet in enumerate(operand):
        value |= (octet & 0x7F) << (7 * index)
    return value


def _dimensions(die: Die) -> Iterator[int]:
    """Yield the dimensions of an array, outermost first."""
    for item in die.iter_children():
        if item.tag != "DW_TAG_subrange_type":
            continue
        if "DW_AT_count" in item.attributes:
            yield _number(item, "DW_AT_count")
        elif "DW_AT_upper_bound" in item.attributes:
            bound = item.attributes["DW_AT_upper_bound"].value
            # A zero-length array's is -1, written as the largest number.
            size = bound + 1 if isinstance(bound, int) else OPEN
            yield size if size < 1 << 31 else OPEN
        else:
            yield OPEN
