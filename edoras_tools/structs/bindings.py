"""Binds structs to packets, and makes the definitions of their messages."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError
from edoras_tools.structs.bound import Bound
from edoras_tools.structs.messages import (
    HEADER_TYPE,
    definition,
    definition_text,
    described,
    header_definition,
    message_type_name,
    parts,
    unique,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.ros.types.schema import Definition
    from edoras_tools.structs.shapes import Key, Struct, StructLayout


class Bindings:
    """The structs of some layouts bound to packets, each named once.

    Args:
        layouts: where several name the same packets, the first applies.

    Attributes:
        all: every struct that is bound, by MsgId and function code.
        by_id: those of a MsgId, function codes first.
        definitions: of their messages, and all that these use, by type.
        texts: the ``.msg`` file of each.

    Raises:
        ConfigError: a struct cannot become a message.
    """

    def __init__(self, layouts: Sequence[StructLayout]) -> None:
        owners: dict[Key, StructLayout] = {}
        for layout in layouts:
            for key in layout.bindings:
                if not any(
                    key.msg_id == other.msg_id and owner is not layout for other, owner in owners.items()
                ):
                    owners[key] = layout
        often = Counter(layout.bindings[key].removesuffix("_t") for key, layout in owners.items())
        self.definitions: dict[str, Definition] = {}
        self.texts: dict[str, str] = {}
        self._names: dict[tuple[int, str, bool], str] = {}
        self._used: set[str] = set()
        bound: list[Bound] = []
        for key, layout in sorted(
            owners.items(), key=lambda item: (item[0].msg_id, item[0].function_code or 0)
        ):
            struct = layout.structs[layout.bindings[key]]
            if struct.header and key.port is not None:
                why = f"{struct.name} begins with a cFE header, which a robot's datagram has not"
                raise ConfigError(f"{layout.origin}: {key}: {why}; bind what follows it")
            if layout.entries:
                type_name = self.define(layout, struct, whole=True)
                bound.append(layout.entries.bind(key, layout, struct, type_name))
                continue
            name = struct.name.removesuffix("_t")
            topic = f"/cfs/{name}/{key}".replace(":", "_") if often[name] > 1 else f"/cfs/{name}"
            bound.append(Bound(key, layout, struct, topic, self.define(layout, struct, whole=True)))
        self.all: tuple[Bound, ...] = tuple(bound)
        self.by_id: dict[int, list[Bound]] = {}
        for item in sorted(bound, key=lambda item: item.key.function_code is None):
            self.by_id.setdefault(item.key.msg_id, []).append(item)

    def define(self, layout: StructLayout, struct: Struct, *, whole: bool) -> str:
        """Make the definition of a struct's message, and of all that it uses; return its type in full."""
        return self._define(layout, struct, whole, ())

    def _define(self, layout: StructLayout, struct: Struct, whole: bool, within: tuple[str, ...]) -> str:
        key = (id(layout), struct.name, whole)
        if key in self._names:
            return self._names[key]
        if struct.name in within:
            raise ConfigError(f"{layout.origin}: {struct.name} contains itself")
        package = f"{layout.package}/msg/"
        name = self._names[key] = package + self._free(package, message_type_name(struct.name))
        names = {}
        if whole and not layout.entries:
            names[HEADER_TYPE] = package + HEADER_TYPE
            self._used.add(names[HEADER_TYPE])
        inside = (*within, struct.name)
        for part in parts(layout, struct, whole=whole):
            nested = layout.structs.get(str(part.member.type))
            if nested is not None:
                names[nested.name] = self._define(layout, nested, False, inside)
        fields = described(layout, struct, names, whole=whole)
        self.definitions[name] = definition(name, fields)
        self.texts[name] = definition_text(struct, fields)
        if HEADER_TYPE in names and names[HEADER_TYPE] not in self.definitions:
            self.definitions[names[HEADER_TYPE]] = header = header_definition(names[HEADER_TYPE])
            self.texts[names[HEADER_TYPE]] = "# what the packet was, and where it came from\n" + header.text
        return name

    def _free(self, package: str, name: str) -> str:
        free = unique(package + name, self._used | {package + HEADER_TYPE})
        self._used.add(free)
        return free.removeprefix(package)
