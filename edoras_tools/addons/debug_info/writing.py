"""Turns C structs from ELF files, headers and layout files into message definitions and a layout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.debug_info.dwarf import SOURCE_SUFFIXES, DebugInfo, Listed, compiled, struct_name
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.outputs import write_files
from edoras_tools.structs import files
from edoras_tools.structs.bindings import Bindings
from edoras_tools.structs.files import LAYOUT_FILE, dumps, load_together
from edoras_tools.structs.shapes import ENTRY_KEY, Key, StructLayout

if TYPE_CHECKING:
    from pathlib import Path


_ELF: Final = b"\x7fELF"
_ARCHIVE: Final = b"!<arch>\n"


class LayoutFile:
    """A layout file as a source of structs.

    Attributes:
        warnings: one line for each part of the file that was not read.
    """

    def __init__(self, layout: StructLayout) -> None:
        self._layout = layout
        self.warnings = list(layout.notes)

    def list(self) -> list[Listed]:
        """Return every struct, sorted by name."""
        return [
            Listed(item.name, item.size, item.header, len(item.members))
            for item in sorted(self._layout.structs.values(), key=lambda item: item.name)
        ]

    def bound(self) -> dict[str, str]:
        """Return the packets that contain structs, by the structs' names."""
        packets_of: dict[str, list[str]] = {}
        entries = self._layout.entries
        for key, name in self._layout.bindings.items():
            entry = entries[key.msg_id - ENTRY_KEY] if entries else None
            packets_of.setdefault(name, []).append(f"{entry.word} {entry.id_text}" if entry else str(key))
        return {name: ", ".join(keys) for name, keys in packets_of.items()}

    def layout(
        self, names: Iterable[str], bindings: Mapping[Key, str], package: str | None
    ) -> tuple[StructLayout, dict[str, str]]:
        """Return some structs, all that they use, and their packets; see ``DebugInfo.layout``."""
        whole = self._layout
        bound = {**whole.bindings, **{key: self._find(name) for key, name in bindings.items()}}
        called = {name: self._find(name) for name in [*names, *bindings.values()]}
        queue = list(called.values())
        needed: dict[str, None] = {}
        while queue:
            name = queue.pop()
            if name not in needed and name in whole.structs:
                needed[name] = None
                queue += [str(member.type) for member in whole.structs[name].members]
        structs = {name: item for name, item in whole.structs.items() if name in needed}
        used = {str(member.type) for item in structs.values() for member in item.members}
        part = replace(
            whole,
            structs=structs,
            enums={name: item for name, item in whole.enums.items() if name in used},
            bindings={key: name for key, name in bound.items() if name in needed},
            package=package or whole.package,
        )
        return part, called

    def _find(self, name: str) -> str:
        names = self._layout.structs
        return struct_name(name, names, self._layout.origin, f"there are {', '.join(names)}")


def open_types(
    path: Path | None, include: Sequence[Path], flags: Sequence[str], more: Sequence[Path] = ()
) -> DebugInfo | LayoutFile:
    """Open a source of structs: an ELF file, a C header, a layout file; None: the built-in layouts.

    Args:
        more: files that make one layout together with the first, as data sheets do.

    Raises:
        ConfigError: a file cannot be read.
    """
    if path is None or (str(path) == files.LAYOUT_NAME and not path.exists()):
        return LayoutFile(files.shipped_layout())
    if path.suffix.lower() in SOURCE_SUFFIXES and not more:
        return compiled(path, include, flags)
    try:
        with path.open("rb") as file:
            start = file.read(len(_ARCHIVE))
    except IsADirectoryError:
        start = b""
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}); name an ELF file, a C header or a layout file"
        ) from error
    if start == _ARCHIVE:
        raise ConfigError(f"{path}: is an archive; extract its objects with 'ar x {path}', and name one")
    if start.startswith(_ELF) and not more:
        return DebugInfo(path)
    return LayoutFile(load_together([path, *more], flags))


def bindings_of(pairs: Iterable[tuple[Key, str]]) -> dict[Key, str]:
    """Return the packets that are assigned to structs.

    Raises:
        ConfigError: one packet is assigned to two structs.
    """
    bindings: dict[Key, str] = {}
    for key, name in pairs:
        if bindings.setdefault(key, name) != name:
            raise ConfigError(f"--bind: {key} is bound to {bindings[key]} and to {name}; leave one out")
    return bindings


class Taken(msgspec.Struct, frozen=True):
    """The requested structs.

    Attributes:
        layout: the structs, and all that they use.
        messages: their messages.
        types: full message type of each requested struct, by the struct's name.
    """

    layout: StructLayout
    messages: Bindings
    types: Mapping[str, str]


def take(
    source: DebugInfo | LayoutFile, names: Sequence[str], bindings: Mapping[Key, str], package: str | None
) -> Taken:
    """Take structs from a source; if none is named, all that begin with a cFE header or are in a packet.

    Raises:
        ConfigError: a struct is not found, or cannot become a message.
    """
    if not names and not bindings:
        listed = source.list()
        headed = [item.name for item in listed if item.header]
        names = headed or list(source.bound()) or [item.name for item in listed]
    layout, called = source.layout(names, bindings, package)
    messages = Bindings([layout])
    types = {item.struct.name: item.type for item in messages.all}
    for name in names:
        own_name = called[name]
        if own_name not in types:
            struct = layout.structs[own_name]
            types[own_name] = messages.define(layout, struct, whole=bool(struct.header))
    return Taken(layout, messages, types)


def write_definitions(definitions: Taken, folder: Path, *, force: bool = False) -> list[Path]:
    """Write the definitions, ``PACKAGE/msg/NAME.msg``, and the layout, ``structs.yaml``.

    The layout of a dictionary is the dictionary itself: of it, only the definitions are written. Nothing is
    written if a file exists with other contents.

    Raises:
        ConfigError: such a file exists, and ``force`` was not given; or a file cannot be written.
    """
    contents = {folder / f"{name}.msg": text for name, text in definitions.messages.texts.items()}
    if not definitions.layout.entries:
        contents[folder / LAYOUT_FILE] = dumps(definitions.layout)
    try:
        write_files({path: text.encode() for path, text in contents.items()}, force=force)
    except CaptureError as error:
        raise ConfigError(f"{error}; name another folder") from error
    return sorted(contents)
