"""The lookup of C structs by packet, for the decoders.

The layout of a dictionary, which an add-on or a package reads (``structs.files.Database``), has
``shapes.LayoutEntries``: its structs follow an ID of their link, not a cFE header. Their method ``table``
makes the ``LayoutEntryTable`` that this package uses.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from copy import copy
from functools import cache, cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.structs.shapes import ENTRY_KEY, UDP_KEY, Key, LayoutEntry, StructLayout, commanded, packets
from edoras_tools.wire.arrays import Integers, Mask, Octets, changes, order_by
from edoras_tools.wire.ccsds import VERSION_1, MsgIds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Reading
    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.library import Definition
    from edoras_tools.structs.bindings import Bindings, Bound, Held, StructPayloads

_NONE: Final = 3
"""Keys after the last entry: for an unknown entry, for bytes that are no entry, and ``NO_MSG_ID``."""


class Structs:
    """The structs that are bound to packets; if layouts name the same packets, the first one applies.

    Args:
        layouts: layouts in that order; None for the built-in layout of cFE, read when a packet first needs
            it.
        msg_ids: version of the MsgIds.
        big_endian: whether the built-in structs are big-endian.

    Attributes:
        msg_ids: version of the MsgIds.
        prefix: start of all topics.
        has: bool, by MsgId or ``UDP_KEY`` plus port: whether a struct is bound to it; False for
            ``NO_MSG_ID``.

    Raises:
        ConfigError: a struct cannot become a message.
    """

    def __init__(
        self,
        layouts: Sequence[StructLayout] | None = (),
        msg_ids: MsgIds = VERSION_1,
        *,
        big_endian: bool = False,
    ) -> None:
        self.msg_ids, self.big_endian, self.prefix = msg_ids, big_endian, ""
        self._layouts = layouts
        self._whole = self
        entries = sum(len(layout.entries or ()) for layout in layouts or ())
        self.has: Mask = np.zeros(ENTRY_KEY + entries + _NONE, np.bool_)
        own = [*packets(msg_ids), *commanded(msg_ids), UDP_KEY]
        self.has[own if layouts is None else list(self._bindings.keys)] = True

    @cached_property
    def layouts(self) -> tuple[StructLayout, ...]:
        """The layouts, in order."""
        if self._layouts is None:
            from edoras_tools.structs import files

            layout = files.shipped_layout(self.msg_ids)
            return (replace(layout, byte_order="big") if self.big_endian else layout,)
        return tuple(self._layouts)

    @cached_property
    def limited(self) -> bool:
        """Whether a layout sets limits for a value."""
        structs = [struct for layout in self._layouts or () for struct in layout.structs.values()]
        return any(member.yellow or member.red for struct in structs for member in struct.members)

    @property
    def _bindings(self) -> Bindings:
        return self._whole._own_bindings  # noqa: SLF001  of its own kind

    @cached_property
    def _own_bindings(self) -> Bindings:
        from edoras_tools.structs.bindings import Bindings

        return Bindings(self.layouts)

    @property
    def dictionary(self) -> LayoutEntryTable | None:
        """The entries of the dictionary, if one of the layouts is a dictionary; else None."""
        return self._whole._entries  # noqa: SLF001  of its own kind

    @cached_property
    def _entries(self) -> LayoutEntryTable | None:
        books = [layout for layout in self._layouts or () if layout.entries]
        if len(books) > 1:
            raise ConfigError(f"{books[1].origin}: a second dictionary, beside {books[0].origin}; name one")
        entries = books[0].entries if books else None
        return entries.table(self) if entries else None

    @property
    def all(self) -> tuple[Bound, ...]:
        """Every bound struct, by MsgId and function code."""
        return tuple(item for item in self._bindings.all if self.has[item.key.msg_id])

    @property
    def definitions(self) -> Mapping[str, Definition]:
        """Every message definition, by type name."""
        return self._bindings.definitions

    def text(self, name: str) -> str | None:
        """Return the complete ``ros2msg`` text of a message type; None if no struct has this type."""
        return self._bindings.text(name)

    @cached_property
    def types(self) -> TypeStore:
        """The types of the messages."""
        from edoras_tools.ros import TypeStore
        from edoras_tools.ros.library import complete_text

        texts = {
            name: complete_text([item, *(other for other in self.definitions.values() if other is not item)])
            for name, item in list(self.definitions.items())[:1]
        }
        return TypeStore(definitions=texts)

    def find(self, msg_id: int, function_code: int | None, length: int) -> Bound | None:
        """Return the struct of a packet with this payload length.

        A packet without a payload is a request or a wake-up, unless its function code has its own struct.
        """
        keys = self._keys(msg_id)
        key = keys.get(function_code, keys.get(None))
        if key is None or (key.function_code is None and length <= 0):
            return None
        return self._bindings.bound(key)

    def name(self, msg_id: int) -> str:
        """Return the name of a MsgId's struct; empty if it has none, or several for different packets."""
        return self.bound_to(msg_id)[0].name if self.is_one(msg_id) else ""

    def is_one(self, msg_id: int) -> bool:
        """Return whether all packets of a MsgId hold the same struct."""
        return len(self._keys(msg_id)) == 1

    def own(self, msg_id: int) -> Sequence[Bound]:
        """Return the structs of a MsgId that a layout names, without the built-in ones."""
        return () if self._layouts is None else [item for item in self.bound_to(msg_id) if not item.shipped]

    @cached_property
    def shared(self) -> tuple[int, ...]:
        """The MsgIds whose function codes have different structs in a layout."""
        own = () if self._layouts is None else self._bindings.keys
        return tuple(msg_id for msg_id in own if msg_id < UDP_KEY and len(self.own(msg_id)) > 1)

    def is_shipped(self, msg_id: int) -> bool:
        """Return whether the structs of a MsgId are the built-in ones of cFE."""
        return self._layouts is None or all(item.shipped for item in self.bound_to(msg_id))

    def unclaimed(self, msg_ids: Iterable[int]) -> Structs:
        """Return the same structs without those of MsgIds that are used otherwise."""
        claimed = [msg_id for msg_id in msg_ids if self.has[msg_id]]
        if not claimed:
            return self
        rest = copy(self)
        rest.has = self.has.copy()
        rest.has[claimed] = False
        return rest

    def under(self, prefix: str) -> Structs:
        """Return the same structs with ``prefix`` in front of their topics."""
        if prefix == self.prefix:
            return self
        other = copy(self)
        other.prefix, other._whole = prefix, other  # noqa: SLF001  of its own kind
        other.__dict__["_own_bindings"] = self._bindings.under(prefix)
        return other

    def of_port(self, port: Any) -> Any:
        """Return the key of datagrams to a port of the robot link, or to each port of an array."""
        key = UDP_KEY + np.asarray(port, np.int32)
        return np.where(self.has[key], key, UDP_KEY)

    def on_ports(self, port: Any, length: Any) -> Any:
        """Return whether a datagram, or each of an array, has a length that a layout names for its port."""
        return sum(((port == own) & item.fits(length) for own, item in self.ports), start=np.False_)

    @cached_property
    def ports(self) -> tuple[tuple[int, Bound], ...]:
        """The UDP ports that a layout names, each with its struct."""
        bound = () if self._layouts is None else self.all
        return tuple((port, item) for item in bound if (port := item.key.port))

    def split(
        self, payloads: StructPayloads, without: Container[Key] = ()
    ) -> Iterator[tuple[Bound, StructPayloads, Mask]]:
        """Yield every struct that packets with these payloads should hold.

        Args:
            payloads: payloads of packets and datagrams.
            without: keys of structs to leave out.

        Yields:
            the struct; the payloads that should hold it; bool, which of these have a length that fits it.
        """
        if not len(payloads.row):
            return
        order = order_by(payloads.key.astype(np.uint32), (payloads.code + 1).astype(np.uint32))
        starts = np.flatnonzero(changes(order, payloads.key, payloads.code))
        ranked, parts = payloads.take(order), dict[Key, list[slice]]()
        kinds = zip(ranked.key[starts].tolist(), ranked.code[starts].tolist(), strict=True)
        for (value, code), span in zip(kinds, pairwise([*starts.tolist(), len(order)]), strict=True):
            keys = self._keys(value)
            if (key := keys.get(code, keys.get(None))) is not None and key not in without:
                parts.setdefault(key, []).append(slice(*span))
        for key in sorted(parts, key=lambda key: (key.msg_id, key.function_code is None)):
            spans = parts[key]
            part = ranked.take(spans[0])
            if len(spans) > 1:
                part = payloads.take(np.sort(np.concatenate([order[span] for span in spans])))
            if key.function_code is None and not (full := part.length > 0).all():
                part = part.take(full)
            if len(part.row):
                item = self._bindings.bound(key)
                yield item, part, item.fits(part.length)

    def payloads_of(
        self, payloads: StructPayloads, columns: Callable[[str], NDArray[Any]], data: Octets
    ) -> Iterator[Held]:
        """Yield the structs that many packets hold, each with the packets that hold it.

        Args:
            payloads: payloads of packets whose MsgIds have a struct, and of datagrams.
            columns: returns a column of the decoder by name.
            data: u8, the buffer that the offsets point into.
        """
        from edoras_tools.structs.bindings import Held

        for item, part, fits in self.split(payloads):
            if fits.any():
                yield Held(item, part if fits.all() else part.take(fits), columns, data)

    def bound_to(self, msg_id: int) -> Sequence[Bound]:
        """Return the structs of a MsgId, in the order in which they are tried."""
        return self._bindings.of(msg_id) if self.has[msg_id] else ()

    def _keys(self, msg_id: int) -> Mapping[int | None, Key]:
        return self._bindings.keys[msg_id] if self.has[msg_id] else {}


@cache
def shipped_structs(msg_ids: MsgIds = VERSION_1, *, big_endian: bool = False) -> Structs:
    """Return the built-in structs of cFE, with MsgIds of a version, in a byte order."""
    return Structs(None, msg_ids, big_endian=big_endian)


class LayoutEntryTable(Protocol):
    """The entries of a dictionary by key; finds them in the datagrams of a link.

    Attributes:
        unknown: key of an ID that is not in the dictionary.
        odd: key of bytes after the last value that are not an ID.
    """

    unknown: int
    odd: int

    def __getitem__(self, key: int, /) -> Bound:
        """Return the struct of a key."""

    def entry(self, key: int) -> LayoutEntry:
        """Return the entry of a key."""

    def payloads(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> StructPayloads:
        """Return the payloads of all entries in the datagrams, in order; rows number the datagrams.

        Args:
            data: u8, the buffer that the offsets point into.
            offset: i64 (n,), first byte of each datagram.
            length: i32 (n,), bytes of each datagram.
        """

    def whole(self, payloads: StructPayloads) -> StructPayloads:
        """Return the payloads that belong to an entry of the dictionary and are complete."""

    def read(self, reading: Reading, kind: int, at: int, end: int) -> bool:
        """Read the entry that one packet of a datagram holds; see ``links.doors.Reading.described``."""

    def logs(self, payloads: StructPayloads, data: Octets) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Yield row, place and fields of ``rcl_interfaces/msg/Log``, except the time, for each event."""

    def engine_values(self) -> dict[str, Any]:
        """Return the data of the entries that the engine of the Wireshark dissector uses, as plain values."""
