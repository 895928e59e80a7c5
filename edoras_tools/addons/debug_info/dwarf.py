"""C structs from debug information: DWARF 2 to 5 of an object file, a library or a program.

Needs pyelftools (``pip install 'edoras-tools[elf]'``).
"""

from __future__ import annotations

import os
import shlex
import subprocess
import tempfile
import zlib
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec.structs import replace

from edoras_tools.addons.debug_info import types
from edoras_tools.addons.debug_info.types import Maker
from edoras_tools.errors import ConfigError
from edoras_tools.structs.shapes import ByteOrder, Key, StructLayout
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence


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


def _shape(die: types.Die) -> tuple[object, ...]:
    """Return the properties by which structs of one name differ."""
    return types.number_attribute(die, "DW_AT_byte_size"), *(
        (types.name_of(item), types.offset_of(item)) for item in types.members_of(die)
    )


def struct_name(name: str, names: Collection[str], origin: object, otherwise: str) -> str:
    """Return the name that a struct has among others; ``_t`` may be absent, or one too many.

    Args:
        origin: file that has the structs, for the error.
        otherwise: advice if no name is similar.

    Raises:
        ConfigError: there is none.
    """
    for spelling in (name, f"{name}_t", name.removesuffix("_t"), types.spelled(name)):
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
        self._found: dict[str, types.Die] = {}
        self._named: dict[int, str] = {}
        self._others: dict[str, list[types.Die]] = {}  # other structs of the same name
        tags: dict[str, types.Die] = {}
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
            for die in types.types_in(top, 0):
                name = types.name_of(die)
                if die.tag == "DW_TAG_typedef":
                    die_type = types.underlying_type(types.type_of(die))
                    if name and die_type is not None and die_type.tag == "DW_TAG_enumeration_type":
                        self._named.setdefault(die_type.offset, name)
                    elif name and die_type is not None and die_type.tag in types.STRUCTS:
                        self._named.setdefault(die_type.offset, name)
                        self._found_as(name, die_type, self._found)
                elif die.tag in types.STRUCTS and name and "DW_AT_declaration" not in die.attributes:
                    self._found_as(name, die, tags)
        for name, die in tags.items():
            self._found.setdefault(self._named.setdefault(die.offset, name), die)

    def _found_as(self, name: str, die: types.Die, among: dict[str, types.Die]) -> None:
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
                    types.number_attribute(die, "DW_AT_byte_size"),
                    self.header(die),
                    len(types.members_of(die)),
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

    def _told_apart(self, die: types.Die) -> None:
        """Warn where a named struct differs between compilation units."""
        name, shape = self.called(die), _shape(die)
        if any(_shape(other) != shape for other in self._others.get(name, ())):
            size = types.number_attribute(die, "DW_AT_byte_size")
            self.warnings.append(
                f"{name} is declared in more than one way; the first is taken, of {size} bytes: check it, or "
                "give the object file that has the right one"
            )

    def find(self, name: str) -> types.Die:
        """Return the entry of a struct.

        Raises:
            ConfigError: no struct has that name; the error lists similar names.
        """
        return self._found[
            struct_name(name, self._found, self.path, f"'edoras structs {self.path}' lists all")
        ]

    def called(self, die: types.Die) -> str:
        """Return the name of a struct or an enumeration; empty if it has none."""
        return self._named.get(die.offset) or types.name_of(die)

    def header(self, die: types.Die) -> int:
        """Return the size in bytes of the cFE header at the beginning of a struct; 0 without one."""
        members = types.members_of(die)
        if (
            not members
            or die.tag not in types.STRUCTS
            or types.STRUCTS[die.tag]
            or types.offset_of(members[0])
        ):
            return 0
        first = members[0]
        kind = types.type_of(first)
        words = [types.name_of(first)]
        for _ in range(types.DEEPEST):
            if kind is None or kind.tag not in {*types.PLAIN, *types.STRUCTS, "DW_TAG_array_type"}:
                break
            words.append(types.name_of(kind))
            kind = types.type_of(kind) if kind.tag in types.PLAIN else None
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
