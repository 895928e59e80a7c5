"""The interface by which the recorded messages of a link are sent again.

Bytes and times in, bytes out: the pipeline has the socket and the clock. A link selects the rows to send,
renews parts of them (counts, checksums, transaction ids), adds messages before, between and after them
(handshake, heartbeats, retransmissions), and gives reasons for messages that it refuses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.links.doors import Framing
    from edoras_tools.model import Columns, Endpoint, Link, PacketBatch
    from edoras_tools.wire.arrays.order import Integers, Mask
    from edoras_tools.wire.layout import Layout

_NEVER: Final = 2**63 - 1


class SendingSession:
    """Messages sent besides the recorded ones; times in ns, monotonic. This session sends none."""

    connected = True
    """Whether messages may be sent; if not, it is checked again a second later, up to ``--timeout``."""
    next_ns = _NEVER
    """Time at which ``due`` has something to send."""
    busy = False
    """Whether the receiver still needs something after the last message."""

    def due(self, *, now: int) -> Iterable[bytes]:
        """Return the datagrams that are due: a handshake, a heartbeat, messages not acknowledged."""
        return ()

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Take bytes from the receiver, any bytes; return the datagrams that answer them."""
        return ()

    def sent(self, *, now: int) -> None:
        """Note that messages were sent."""
        del now

    def absence(self) -> str:
        """Return the reason why it is not connected, for the user; empty: nothing answered."""
        return ""

    def goodbye(self) -> Iterable[bytes]:
        """Return the datagrams that end the session."""
        return ()

    def notes(self) -> Iterable[str]:
        """Return the results for the user, a line each."""
        return ()


class LinkSending:
    """Sends the messages of a link again; the defaults are right for bare datagrams.

    Args:
        link: link of the messages.

    Attributes:
        link: link of the messages.
        port: usual port of the receiver; 0: the user has to name it.
        framing: framing of the receiver's answers; the messages then go over one TCP connection, else over
            UDP.
        renews: whether ``renew`` replaces the recorded messages.
        packets: whether the messages are the space packets of the rows, without the bytes before them.
        own_transport: whether ``transmitter`` returns the carrier of the messages.
        instead: alternative to suggest for a link without ``compose``.
        session: session besides the messages; None: nothing.
        refusals: messages that are not sent, with reasons, a line each; complete after all rows were
            processed.
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
        """Return which rows go to the receiver, bool (n,)."""
        return np.asarray(columns.link == self.link)

    def keep(self, batch: PacketBatch) -> None:
        """Note the rows that are sent, in order, of the batch that ``outgoing_rows`` had last."""

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return composed messages, for ``inject``; a link of ``packets`` gets those of routes.

        Args:
            name: name of the message, as the link's users write it.
            values: plain values: by name, or in order.
            count: number of messages, for links that number them.
            context: a ``decode.Context``: the mission, layouts and dictionaries.

        Raises:
            ConfigError: there is no such message, or messages of the link cannot be composed.
            FieldError: a value does not fit.
        """
        raise ConfigError(f"no message of {self.link.label} is made up: {self.instead}")

    def transmitter(self, target: Endpoint) -> Any:
        """Return a carrier of the messages instead of a socket, with the interface of ``Transmitter``.

        Raises:
            EdorasError: it cannot be opened.
        """
        raise NotImplementedError(self.link.label)

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Return the messages to send instead of the recorded ones, and their times; if it ``renews``.

        Raises:
            ConfigError: they cannot be made; the text says what is missing.
        """
        return list(messages), time_ns


class FormSending(LinkSending):
    """Messages of one header and nothing else, unchanged: those that are sent to one port."""

    def __init__(self, link: Link, port: int, layouts: Sequence[Layout]) -> None:
        super().__init__(link)
        self.port, self._layouts = port, {item.name: item for item in layouts}

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows have the length of one of its messages."""
        lengths = [item.size for item in self._layouts.values()]
        return super().outgoing_rows(batch, columns) & np.isin(batch.length, lengths)

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return a message; fields without a value are 0."""
        layout = self._layouts.get(name.lower())
        if layout is None:
            raise ConfigError(f"{name!r} does not go this way; there are {', '.join(self._layouts)}")
        numbers = isinstance(values, dict) and all(isinstance(item, (int, float)) for item in values.values())
        if not numbers:
            raise ConfigError(f"{name} takes numbers: {{{layout.slots[0].field.name}: 0.5}}")
        return [layout.emit(values)] * count
