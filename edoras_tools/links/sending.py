"""What the door ``send`` of a link gives: how what a recording holds of it goes out again.

Bytes and times in, bytes out: the pipeline has the socket and the clock. A link says which rows it sends,
what of them must be new (counts, checksums, transaction ids), what is said before, between and after
(handshake, heartbeats, what is asked for again), and what it refuses, and why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.links.framing import Framing
    from edoras_tools.model import Columns, Endpoint, Link, PacketBatch
    from edoras_tools.wire.arrays.order import Integers, Mask
    from edoras_tools.wire.layout import Layout

_NEVER: Final = 2**63 - 1


class SendingSession:
    """What is said besides the messages; times in ns, monotonic. This one is silent."""

    connected = True
    """Whether messages may go; else a second later it is asked again, up to ``--timeout``."""
    next_ns = _NEVER
    """When ``due`` has something to say."""
    busy = False
    """Whether the receiver still needs something after the last message."""

    def due(self, *, now: int) -> Iterable[bytes]:
        """Return what is due: a handshake, a heartbeat, what was not acknowledged."""
        return ()

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Take what the receiver sends, any bytes; return what that asks for."""
        return ()

    def sent(self, *, now: int) -> None:
        """Note that messages were sent."""
        del now

    def absence(self) -> str:
        """Return why it is not connected, for the user; empty: nothing answered."""
        return ""

    def goodbye(self) -> Iterable[bytes]:
        """Return what ends the session."""
        return ()

    def notes(self) -> Iterable[str]:
        """Return what became of it, for the user, a line each."""
        return ()


class LinkSending:
    """How the messages of a link are sent again; what stands here is right for bare datagrams.

    Args:
        link: as given.

    Attributes:
        link: of the messages.
        port: where the receiver usually listens; 0: it has to be named.
        framing: cuts what the receiver answers; the messages then go over one TCP connection, else over UDP.
        renews: whether ``renew`` makes others of the recorded messages.
        packets: whether the messages are the space packets of the rows, without what is in front of them.
        own_transport: whether ``transmitter`` gives what carries the messages.
        instead: of a link without ``compose``, what can be done.
        session: what is said besides the messages; None: nothing.
        refusals: what is not sent, and why, a line each; known once all rows were asked for.
    """

    port: int = 0
    framing: Framing | None = None
    renews: ClassVar[bool] = False
    packets: ClassVar[bool] = False
    own_transport: ClassVar[bool] = False
    instead: ClassVar[str] = "edoras replay sends what was recorded"
    session: SendingSession | None = None

    def __init__(self, link: Link) -> None:
        self.link = link
        self.refusals: list[str] = []

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Tell which rows go to the receiver, bool (n,)."""
        return np.asarray(columns.link == self.link)

    def keep(self, batch: PacketBatch) -> None:
        """Note the rows that are sent, in their order, of the batch that ``outgoing_rows`` had last."""

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return messages that are made up, for ``inject``; a link of ``packets`` is given those of routes.

        Args:
            name: of the message, as the link's users call it.
            values: plain values: by name, or in their order.
            count: how many, for links that number their messages.
            context: a ``decode.Context``: the mission, and what layouts and dictionaries say.

        Raises:
            ConfigError: there is no such message, or nothing makes messages of the link.
            FieldError: a value does not fit.
        """
        raise ConfigError(f"no message of {self.link.label} is made up: {self.instead}")

    def transmitter(self, target: Endpoint) -> Any:
        """Return what carries the messages in place of a socket, with what ``io``'s ``Transmitter`` has.

        Raises:
            EdorasError: it cannot be opened.
        """
        raise NotImplementedError(self.link.label)

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Return what is sent for all messages, and when; for a link that ``renews``.

        Raises:
            ConfigError: nothing can be made of them; says what is missing.
        """
        return list(messages), time_ns


class FormSending(LinkSending):
    """Messages of one header and nothing else, as they are: those that are sent to one port."""

    def __init__(self, link: Link, port: int, layouts: Sequence[Layout]) -> None:
        super().__init__(link)
        self.port, self._layouts = port, {item.name: item for item in layouts}

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Tell which rows are as long as one of them."""
        lengths = [item.size for item in self._layouts.values()]
        return super().outgoing_rows(batch, columns) & np.isin(batch.length, lengths)

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return a message; what is not named is 0."""
        layout = self._layouts.get(name.lower())
        if layout is None:
            raise ConfigError(f"{name!r} does not go this way; there are {', '.join(self._layouts)}")
        numbers = isinstance(values, dict) and all(isinstance(item, (int, float)) for item in values.values())
        if not numbers:
            raise ConfigError(f"{name} takes numbers: {{{layout.slots[0].field.name}: 0.5}}")
        return [layout.emit(values)] * count
