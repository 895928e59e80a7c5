"""Binds structs to packets, and makes the definitions of their messages."""

from __future__ import annotations

from collections import Counter
from copy import copy
from typing import TYPE_CHECKING

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import Definition, complete_text, with_used
from edoras_tools.structs import messages
from edoras_tools.structs.bound import Bound
from edoras_tools.structs.shapes import SHIPPED, Key, Struct, StructLayout

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


class Bindings:
    """The structs of some layouts, each bound to the packets that hold it and named once.

    The built-in structs are bound only when they are used: no two of them have the same name.

    Args:
        layouts: the layouts; if several bind the same MsgId, the first one applies.

    Attributes:
        keys: the keys of each MsgId, by function code in rising order; the key for all other codes is under
            None.

    Raises:
        ConfigError: a struct cannot become a message.
    """

    def __init__(self, layouts: Sequence[StructLayout]) -> None:
        first: dict[int, StructLayout] = {}
        owners = {
            key: layout
            for layout in layouts
            for key in layout.bindings
            if first.setdefault(key.msg_id, layout) is layout
        }
        self._owners = dict(
            sorted(owners.items(), key=lambda item: (item[0].msg_id, item[0].function_code or 0))
        )
        self._often = Counter(layout.bindings[key].removesuffix("_t") for key, layout in owners.items())
        self.keys: dict[int, dict[int | None, Key]] = {}
        for key in sorted(self._owners, key=lambda key: key.function_code is None):
            self.keys.setdefault(key.msg_id, {})[key.function_code] = key
        self._bound: dict[Key, Bound] = {}
        self._prefix = ""
        self._definitions: dict[str, Definition] = {}
        self._texts: dict[str, str] = {}
        self._names: dict[tuple[int, str, bool], str] = {}
        self._used: set[str] = set()
        if any(layout.origin != SHIPPED for layout in layouts):
            _ = self.all  # this raises the ConfigError of a wrong layout now

    def under(self, prefix: str) -> Bindings:
        """Return these structs with ``prefix`` in front of their topics; the definitions are the same."""
        other = copy(self)
        other._prefix, other._bound = prefix, {}  # noqa: SLF001  of its own kind
        return other

    @property
    def all(self) -> tuple[Bound, ...]:
        """Every bound struct, by MsgId and function code."""
        return tuple(map(self.bound, self._owners))

    def of(self, msg_id: int) -> list[Bound]:
        """Return the structs of a MsgId, in the order of ``keys``."""
        return list(map(self.bound, self.keys[msg_id].values()))

    @property
    def definitions(self) -> Mapping[str, Definition]:
        """The definitions of all messages and of all types that these use, by type name."""
        _ = self.all
        return self._definitions

    @property
    def texts(self) -> Mapping[str, str]:
        """The ``.msg`` text of each of these definitions, by type name."""
        _ = self.all
        return self._texts

    def text(self, name: str) -> str | None:
        """Return the complete ``ros2msg`` text of a message type; None if no bound struct has this type."""
        is_bound = name in self._definitions
        return complete_text(with_used(name, self._definitions.__getitem__)) if is_bound else None

    def bound(self, key: Key) -> Bound:
        """Return the bound struct of a key, one of ``keys``."""
        if key not in self._bound:
            self._bound[key] = self._new(key, self._owners[key])
        return self._bound[key]

    def _new(self, key: Key, layout: StructLayout) -> Bound:
        struct = layout.structs[layout.bindings[key]]
        if struct.header and key.port is not None:
            why = f"{struct.name} begins with a cFE header, which a robot's datagram has not"
            raise ConfigError(f"{layout.origin}: {key}: {why}; bind what follows it")
        type_name = self.define(layout, struct, whole=True)
        if layout.entries:
            return layout.entries.bind(key, layout, struct, type_name)
        name = struct.name.removesuffix("_t")
        topic = f"/cfs/{name}/{key}".replace(":", "_") if self._often[name] > 1 else f"/cfs/{name}"
        return Bound(key, layout, struct, self._prefix + topic, type_name)

    def define(self, layout: StructLayout, struct: Struct, *, whole: bool) -> str:
        """Define the message of a struct, and every type that it uses; return its full type name."""
        return self._define(layout, struct, whole, ())

    def _define(self, layout: StructLayout, struct: Struct, whole: bool, within: tuple[str, ...]) -> str:
        key = (id(layout), struct.name, whole)
        if key in self._names:
            return self._names[key]
        if struct.name in within:
            raise ConfigError(f"{layout.origin}: {struct.name} contains itself")
        package = f"{layout.package}/msg/"
        name = self._names[key] = package + self._free(package, messages.message_type_name(struct.name))
        names = {}
        if whole and not layout.entries:
            names[messages.HEADER_TYPE] = package + messages.HEADER_TYPE
            self._used.add(names[messages.HEADER_TYPE])
        inside = (*within, struct.name)
        for part in messages.parts(layout, struct, whole=whole):
            nested = layout.structs.get(str(part.member.type))
            if nested is not None:
                names[nested.name] = self._define(layout, nested, False, inside)
        fields = messages.described(layout, struct, names, whole=whole)
        self._definitions[name] = messages.definition(name, fields)
        self._texts[name] = messages.definition_text(struct, fields)
        if messages.HEADER_TYPE in names and names[messages.HEADER_TYPE] not in self._definitions:
            self._definitions[names[messages.HEADER_TYPE]] = header = messages.header_definition(
                names[messages.HEADER_TYPE]
            )
            self._texts[names[messages.HEADER_TYPE]] = (
                "# what the packet was, and where it came from\n" + header.text
            )
        return name

    def _free(self, package: str, name: str) -> str:
        free = messages.unique(package + name, self._used | {package + messages.HEADER_TYPE})
        self._used.add(free)
        return free.removeprefix(package)
