"""The table of links: the built-in ones, and those that installed packages add (``edoras.links``).

Two links stand here that no wire carries: packets in files of cFS, and the entries of its reset log.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

import numpy as np

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.links import ROWS
from edoras_tools.links.protocol import CERTAIN, Form, LinkProtocol, Seen
from edoras_tools.model import OTHER, Columns, Decoded, Link, Transport
from edoras_tools.wire.cfe import RESET_ENTRY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Framing
    from edoras_tools.wire.arrays import Mask

State = TypeVar("State")
_LABEL: Final = re.compile(r"[a-z][a-z0-9_]{0,15}")
_CODES: Final = 256
"""Number of codes: a code is a byte in recordings; 0 is for datagrams of no link."""


@cache
def links() -> tuple[LinkProtocol, ...]:
    """Return every link: the shipped ones by code, then the installed ones by label.

    A link of an add-on whose folder was deleted is left out: its datagrams belong to no link.

    Raises:
        ConfigError: an installed link cannot be loaded, or its label or code is in use or is not allowed.
    """
    places = ROWS | {name: item.place for name, item in doors.shipped("links").items() if not item.absent}
    ships: list[LinkProtocol] = sorted(map(doors.imported, places.values()))
    by_label = {link.label: link for link in ships}
    for item in doors.installed("links"):
        by_label[item.name] = _checked(item, item.load(), by_label)
    return tuple(by_label.values())


def _checked(item: doors.Addition, link: Any, by_label: dict[str, LinkProtocol]) -> LinkProtocol:
    """Return an installed link after checking the rules of the table.

    Raises:
        ConfigError: it breaks one.
    """
    if not isinstance(link, LinkProtocol):
        raise item.error(f"{item.place} is not an object of a class made from LinkProtocol")
    if link.label != item.name or not _LABEL.fullmatch(link.label):
        form = "a small letter, then at most 15 small letters, digits or _"
        raise item.error(f"its label is {link.label!r}; it must be its entry's name, {form}")
    if link.label in by_label or link.label == OTHER.label:
        raise item.error("another link has this label; uninstall one of them")
    if not 0 < link.code < _CODES or link.code in by_label.values():
        free = "choose one from 64 to 255 that is free"
        raise item.error(f"its code {link.code} is taken or is not a byte; {free}")
    return link


@cache
def _by_code() -> dict[int, LinkProtocol | Link]:
    return {0: OTHER, **{int(link): link for link in links()}}


def link(code: int) -> Link:
    """Return the link with a code; ``OTHER`` if there is none."""
    return _by_code().get(int(code), OTHER)


def protocol(link: Link) -> LinkProtocol:
    """Return the object that reads a link's datagrams; ``link`` must not be ``OTHER``."""
    reader = _by_code()[link]
    assert isinstance(reader, LinkProtocol)
    return reader


def framings(ports: Iterable[tuple[Link, int]] = ()) -> dict[int, Framing]:
    """Return the framing of TCP streams, by port: of the usual ports of every link, and of some more.

    Args:
        ports: further links and ports; those of links without TCP are left out.
    """
    usual = [(item, port) for item in links() for port in item.transport.ports]
    by_port: dict[int, Framing] = {}
    for item, port in (*ports, *usual):
        framing = protocol(item).framing if item != OTHER else None
        if framing is not None:
            by_port.setdefault(port, framing)
    return by_port


@cache
def link_of_label(name: str) -> Link:
    """Return the link with a label, in any case; ``other`` is allowed.

    Raises:
        ConfigError: there is no such link.
    """
    by_label = {item.label: item for item in (*links(), OTHER)}
    if name.lower() not in by_label:
        raise ConfigError(f"{name!r} is not a link; there are {', '.join(by_label)}")
    return by_label[name.lower()]


def carrying(bridge: str, *, to_cfs: bool) -> Link:
    """Return the link that carries the routes of a kind of EDORAS bridge in one direction.

    Args:
        bridge: ``ground`` or ``flight``.
        to_cfs: direction: towards cFS, or from it.
    """
    return next(
        item for item in links() if item.bridge == bridge and (item.to_cfs if to_cfs else item.from_cfs)
    )


def message_kinds(columns: Columns, length: NDArray[np.int32]) -> NDArray[np.int16]:
    """Return the link's own message type of each datagram, i16 (n,); -1 for none.

    Args:
        length: bytes of the payloads, (n,).
    """
    kinds = columns.sbn_msg_type
    for item in links():
        rows = np.flatnonzero(columns.link == item) if item.forms else ()
        if len(rows):
            kinds = kinds.copy()
            kinds[rows] = item.kinds(length[rows])
    return kinds


def among(column: NDArray[np.integer[Any]], accepts: Callable[[Link], bool]) -> Mask:
    """Return which codes are of a link that a test accepts: ``among(rows.link, lambda link: link.to_cfs)``.

    Returns:
        bool (n,).
    """
    # Indexing a table with the column takes eight times as long.
    codes = bytearray(column.astype(np.uint8, copy=False).data)
    return np.frombuffer(codes.translate(accepted(accepts).data), np.bool_)


def accepted(accepts: Callable[[Link], bool]) -> Mask:
    """Return which codes are of a link that a test accepts, bool (256,)."""
    table = np.zeros(1 << 8, np.bool_)
    table[[code for code, item in _by_code().items() if accepts(item)]] = True
    return table


class LinkStates(Generic[State]):
    """The states of links in one stream; each begins with the first datagram of its link.

    Args:
        begin: returns the state of a link; None if it has none.

    Attributes:
        by_link: states that have begun.
    """

    def __init__(self, begin: Callable[[LinkProtocol], State | None]) -> None:
        self._begin, self._waiting = begin, list(links())
        self.by_link: dict[Link, State] = {}

    def of(self, columns: Columns) -> list[State]:
        """Return the states for a batch, including those that begin with it."""
        met = columns.link.tobytes()
        self.begin(link for link in self._waiting if link.in_packets or int(link) in met)
        return [*self.by_link.values()]

    def begin(self, some: Iterable[LinkProtocol] | None = None) -> None:
        """Begin the states of some links, by default of all; each is begun once."""
        for link in list(self._waiting if some is None else some):
            if link in self._waiting:
                self._waiting.remove(link)
                if (state := self._begin(link)) is not None:
                    self.by_link[link] = state


class StoredLink(LinkProtocol):
    """The packets of a file; no wire carries them, so its port is 0, which no datagram has."""

    code = 9
    name = "FILE"
    label = "file"
    colour = "dim"
    doc = "packets in a file that cFS wrote (event log, Data Storage)"
    transport = Transport(ports=(0,), first="server")
    from_cfs = True
    packets = True


STORED: Final = StoredLink()


_KINDS: Final = {name: set(RESET_ENTRY.by_name[name].field.names) for name in ("entry_type", "reset_type")}


class ResetsLink(LinkProtocol):
    """The entries of a reset log; no wire carries them, so their port is 0, like that of stored packets.

    No stored packet is taken for one: the first bytes of an entry would be a packet of another length.
    """

    code = 11
    name = "RESET"
    label = "reset"
    colour = "red"
    doc = "entries of an exception and reset log that cFS wrote to a file"
    transport = Transport(ports=(0,), first="server")
    from_cfs = True
    layouts = (RESET_ENTRY,)
    forms: ClassVar = {RESET_ENTRY.size: Form((RESET_ENTRY,))}

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if length and kinds are those of an entry."""
        sure: Any = CERTAIN * (facts.length == RESET_ENTRY.size) * (facts.destination_port == 0)
        for name, kinds in _KINDS.items():
            value = facts.field(RESET_ENTRY, name)
            sure = sure * sum((value == kind) for kind in kinds)
        return sure

    def summary(self, decoded: Decoded) -> str:
        """Return the event that the log describes."""
        if not decoded.layers:
            return ""
        entry = {field.name: field for field in decoded.layers[0].fields}
        return f"reset log, {entry['entry_type'].text.partition(' (')[0]}: {entry['description'].value}"


RESETS: Final = ResetsLink()
