"""The interface of a link, and the default readers, which are enough for most links.

Rules that every link keeps:

1. It is frozen: knowledge of one stream is kept in the :class:`Site` that the caller passes.
2. :meth:`LinkProtocol.locate` (many datagrams, as columns) and :meth:`LinkProtocol.dissect` (one, for people)
   give the same packet offsets and the same findings for any bytes.
3. It raises nothing but ``WireError``, for any bytes, and only in ``dissect``.

``LinkSending`` sends the recorded messages of a link again. Bytes and times in, bytes out: the pipeline has
the socket and the clock. A link selects the rows to send, renews parts of them (counts, checksums,
transaction ids), adds messages before, between and after them (handshake, heartbeats, retransmissions), and
gives reasons for messages that it refuses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, Protocol

import numpy as np

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.model import Columns, Datagram, Decoded, Endpoint, Finding, Link, PacketBatch
from edoras_tools.wire import ccsds
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import (
        Follower,
        Framing,
        LinkEvidence,
        OwnRows,
        OwnTopics,
        Reading,
        SampleReader,
        Site,
        TopicSpace,
        Unwrapper,
    )
    from edoras_tools.wire.arrays import Integers, Mask, Octets, Places

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


BY_PORT: Final = 1
BY_CONTENT: Final = 2
BY_ADDRESS: Final = 4
CERTAIN: Final = 8
"""Confidence of a link that a datagram is its own; 0: it is not. The highest wins; of equals, the later."""

SMALLEST_DOUBLE: Final = 1023 - 256
LARGEST_DOUBLE: Final = 1023 + 63
"""IEEE 754 exponents, bias included, of the smallest and largest value that a double is likely to have:
about 1e-77 and 1e19. Zero and subnormal values count as well; infinities and NaN do not."""
_EXPONENT: Final = 0x7FF0
_TOP: Final = Field("top", 16, "sign, exponent, first 4 bits of the fraction")
_REST: Final = Field("rest", 48, "the other bits of the fraction", kind="bytes")
_DOUBLES: Final = (
    Layout("double_big", "Double", _TOP, _REST),
    Layout("double_little", "Double", _REST, _TOP, byte_order="little"),
)


class Form(NamedTuple):
    """One kind of datagram of a link, recognised by its length and by the doubles that it starts with.

    Attributes:
        headers: headers at the beginning, in wire order.
        port: usual destination port of this form; 0 for any of the link's.
        doubles: number of doubles at the beginning, all in one byte order; if one of them is no likely value,
            the datagram is not of this form.
    """

    headers: tuple[Layout, ...]
    port: int = 0
    doubles: int = 0


class Seen(Protocol):
    """The facts by which a link recognises a datagram: values for one datagram, or arrays for many.

    The operators ``+ * & | == < >`` work on both; ``not``, ``~``, ``and`` and ``or`` do not.
    """

    @property
    def length(self) -> Any:
        """Bytes of the payload."""

    @property
    def destination_port(self) -> Any:
        """The destination port."""

    @property
    def to_cfs(self) -> Any:
        """Whether its destination is the address of a cFS in the mission."""

    @property
    def from_cfs(self) -> Any:
        """Whether its source is the address of a cFS in the mission."""

    @property
    def bound(self) -> Any:
        """Whether its length is that of a C struct bound to the destination port."""

    def field(self, layout: Layout, name: str, at: int = 0) -> Any:
        """Return a number of a header that starts at byte ``at``; -1 if the payload ends before it."""


class Located:
    """The starts of the space packets in some datagrams, and the contents of the headers before them.

    Args:
        count: number of datagrams.

    Attributes:
        start: first byte of the space packet in the payload, i32 (n,); -1 if there is none.
        findings: set of ``Finding`` bits, u32 (n,).
        columns: further columns of ``Columns`` by name, (n,) each.
    """

    def __init__(self, count: int) -> None:
        self.start = np.full(count, -1, np.int32)
        self.findings = np.zeros(count, np.uint32)
        self.columns: dict[str, NDArray[Any]] = {}

    def flag(self, finding: Finding, mask: Mask, rows: Places | None = None) -> None:
        """Set a finding's bit where ``mask`` is True, for all datagrams or for some ``rows`` of them."""
        if mask.any():
            at = np.flatnonzero(mask) if rows is None else rows[mask]
            self.findings[at] |= np.uint32(finding)


class BatchRows(Protocol):
    """Some decoded datagrams of a batch: arrays of one length."""

    @property
    def batch(self) -> PacketBatch:
        """The whole batch; offsets point into its ``data``."""

    @property
    def context(self) -> Site:
        """The knowledge about the place of the capture."""

    def column(self, name: str) -> NDArray[Any]:
        """Return one of ``Columns``."""

    def datagram(self, name: str) -> NDArray[Any]:
        """Return one of the columns of the batch."""


class LinkProtocol(Link):
    """A link whose datagrams can be read.

    A link with fixed headers before a space packet, or with messages of fixed lengths, only sets the
    attributes; a link whose headers depend on their content overrides the methods.

    Attributes:
        layouts: its own headers before a space packet, in wire order.
        forms: kinds of datagrams by their length; datagrams of other lengths are not this link's.
        constants: fields of its first header with a fixed value; other datagrams are not this link's.
        port_sure: confidence by the port alone.
        sender_port: whether the source port is enough if the destination port decides nothing.
        wireshark: name of Wireshark's own dissector, which gets the link's datagrams; empty for ours.
        framing: framing of its messages in TCP streams, if ``transport`` has them.
        sends: whether ``send`` is implemented.
        magic: first bytes of every datagram; they are recognised on any port that no other link has, and if
            there are four of them, ``--set port=LINK:any`` captures them; empty if no bytes identify the
            link.
    """

    layouts: ClassVar[tuple[Layout, ...]] = ()
    forms: ClassVar[Mapping[int, Form]] = {}
    constants: ClassVar[Mapping[str, int]] = {}
    port_sure: ClassVar[int] = BY_PORT
    sender_port: ClassVar[bool] = False
    wireshark: ClassVar[str] = ""
    framing: ClassVar[Framing | None] = None
    magic: ClassVar[bytes] = b""
    sends: ClassVar[bool] = False

    @classmethod
    def part(cls, place: str) -> Any:
        """Import a class or function of the link when it is needed.

        Args:
            place: ``module:name``, in the folder of the link.
        """
        return doors.imported(f"{cls.__module__.rpartition('.')[0]}.{place}".removeprefix("."))

    @property
    def port_decides(self) -> bool:
        """Whether its port is enough if no other link claims that port."""
        return not self.forms and not self.constants

    @property
    def relayed(self) -> bool:
        """Whether a relay can stand between its ends, because both send to fixed ports."""
        return all(self.transport.ports) and not self.magic

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence that a datagram to one of its ports is its own: a sum of the constants above.

        A link with one direction prefers datagrams in that direction by address, then packets of that type. A
        datagram without a packet is for cFS: Telemetry Output never sends one.
        """
        if self.forms:
            return BY_CONTENT * self._has_form(facts)
        sure: Any = self.port_sure * (facts.length >= 0)
        if self.constants:
            sure = BY_CONTENT * (facts.length >= self.layouts[0].size)
            for name, value in self.constants.items():
                sure = sure * (facts.field(self.layouts[0], name) == value)
        if self.to_cfs == self.from_cfs:
            return sure
        command = facts.field(ccsds.PRIMARY, "packet_type", self.header_bytes) != ccsds.TELEMETRY_TYPE
        this_way = facts.to_cfs > facts.from_cfs if self.to_cfs else facts.from_cfs > facts.to_cfs
        return sure + (sure > 0) * ((command == self.to_cfs) + BY_ADDRESS * this_way)

    def _has_form(self, facts: Seen) -> Any:
        usual = sum((facts.destination_port == form.port) for form in self.forms.values() if form.port)
        return sum(
            (facts.length == length)
            & ((usual == 0) | (facts.destination_port == form.port) | (form.port == 0))
            & _likely_doubles(facts, form.doubles)
            for length, form in self.forms.items()
        )

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Find the start of the space packet in many datagrams.

        Args:
            rows: rows of this link, in the order they were captured.
        """
        located = Located(len(rows))
        if self.packets:
            whole = batch.length[rows] >= self.header_bytes
            located.start[whole] = self.header_bytes
            located.flag(Finding.TRUNCATED, ~whole)
        return located

    def dissect(self, reading: Reading, site: Site) -> int | None:
        """Read the headers of one datagram; return the start of its space packet, None if there is none.

        Raises:
            WireError: a header is incomplete; the layers read before it are kept.
        """
        at = 0
        form = self.forms.get(len(reading.data))
        whole = bool(self.forms) and Finding.CAPTURE_CUT not in reading.findings
        for layout in form.headers if form else () if whole else self.layouts:
            reading.read(layout, at)
            at += layout.size
        return at if self.packets else None

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find one of ``layouts`` in decoded datagrams, for filters and tables.

        Args:
            field: field that must be present; datagrams whose header does not have it are left out.

        Returns:
            The rows that have the layout, and its start in the data of the batch.
        """
        length = rows.datagram("length")
        present, at = rows.column("link") == self, 0
        if self.forms:
            present &= np.isin(length, [size for size, form in self.forms.items() if layout in form.headers])
            (headers,) = {form.headers for form in self.forms.values() if layout in form.headers}
        else:
            headers = self.layouts
        at = sum(item.size for item in headers[: headers.index(layout)])
        owner = np.flatnonzero(present & (length >= at + layout.size))
        return owner, rows.datagram("offset")[owner] + at

    def kinds(self, length: NDArray[np.int32]) -> NDArray[np.int16]:
        """Return the index in ``forms`` of datagrams of these lengths, i16 (n,); -1 for none."""
        kinds = np.full(len(length), -1, np.int16)
        for index, size in enumerate(self.forms):
            kinds[length == size] = index
        return kinds

    def message_name(self, kind: int) -> str:
        """Return the name of a message that is not a space packet, e.g. ``SBN_SUB``; empty if it has none.

        Args:
            kind: index in ``forms``, or the link's own message type.
        """
        form = list(self.forms.values())[kind] if 0 <= kind < len(self.forms) else None
        return form.headers[-1].name.upper() if form else ""

    def kind_name(self, decoded: Decoded) -> str:
        """Return the kind of a datagram without a MsgId, without its numbers; empty if it is unreadable."""
        return decoded.layers[-1].title if decoded.layers else ""

    def topics(self, space: TopicSpace) -> OwnTopics | None:
        """Return a maker of messages from its datagrams; None if routes and structs cover all of them.

        It is called once a recording, at the first datagram of the link.
        """
        return None

    def rows(self, site: Site) -> OwnRows | None:
        """Return a reassembler of its pieces; None if each datagram is whole.

        It is called once a stream, at the first datagram of the link.
        """
        return None

    def unwrapper(self, site: Site) -> Unwrapper | None:
        """Return an extractor of packets in its datagrams; None if they carry none. Called once a stream."""
        return None

    def follow(self, site: Site) -> Follower | None:
        """Return a counter for ``info``; None: its rows are enough.

        It is called once a stream, at the first datagram of the link.
        """
        return None

    def evidence(self, site: Site) -> LinkEvidence | None:
        """Return an observer for the doctor that sees more than rows; else None. See ``follow``."""
        return None

    def send(self, site: Site, *, up: bool) -> LinkSending | None:
        """Return a sender that sends its messages again; None if there is none.

        Args:
            site: knowledge of the mission.
            up: direction: towards the flight software, or the other way.
        """
        return None

    def fields(self) -> Iterable[Any]:
        """Return its filter fields besides its layouts, each a ``decode.filters.field.FilterField``."""
        return ()

    def engine_values(self) -> Mapping[str, Any]:
        """Return its values for the engine of the Wireshark dissector besides layouts, as plain values."""
        return {}

    def sample_reader(self) -> SampleReader:
        """Return the reader of the samples in its datagrams, for a link with ``samples``."""
        raise NotImplementedError(self.label)

    def claims(self, datagram: Datagram, site: Site) -> bool:
        """Return whether a datagram is its own by the mission, independent of other links' claims."""
        return False

    def claimed(self, batch: PacketBatch, site: Site) -> Places:
        """Return the rows of a batch that it ``claims``."""
        return np.zeros(0, np.intp)

    def framing_of(self, carried: Link, form: Any) -> Framing | None:
        """Return the framing of a TCP stream of frames with packets of a link; None if it is another link's.

        Args:
            form: format of the frames, as in ``mission.FramedPort.format``.
        """
        return None

    def holds_units(self, column: Callable[[str], NDArray[Any]], site: Site) -> Mask:
        """Return which rows are packets that hold a unit of it after their cFE header; for ``in_packets``.

        Args:
            column: returns one of ``Columns`` by name.
        """
        raise NotImplementedError(self.label)

    def judge_units(
        self, data: Octets, offset: Integers, length: NDArray[np.int32]
    ) -> Iterator[tuple[Finding, Mask]]:
        """Yield each finding about units in packets, and the units that have it; for ``in_packets``."""
        raise NotImplementedError(self.label)

    def read_unit(self, reading: Reading, at: int) -> None:
        """Read the layers of a unit from a byte of a datagram on; for ``in_packets``.

        Raises:
            TruncatedError: it needs more bytes than are present.
        """
        raise NotImplementedError(self.label)

    def quoted(self, datagram: Datagram) -> Datagram:
        """Return the datagram whose beginning a message contains, for a link that ``quotes``.

        Its absent bytes count as cut off by the capture.
        """
        raise NotImplementedError(self.label)

    def summary(self, decoded: Decoded) -> str:
        """Return one line on a datagram without a space packet, or an empty string."""
        return decoded.layers[-1].title if decoded.layers and not self.packets else ""


def _likely_doubles(facts: Seen, count: int) -> Any:
    """Return whether the first doubles are likely values in one byte order; those cut off are likely."""
    likely: Any = count == 0
    for layout in _DOUBLES if count else ():
        fits: Any = True
        for index in range(count):
            top = facts.field(layout, "top", index * layout.size)
            exponent = top & _EXPONENT
            within = (exponent >= SMALLEST_DOUBLE << 4) & (exponent <= LARGEST_DOUBLE << 4)
            fits = fits & ((top < 0) | (exponent == 0) | within)
        likely = likely | fits
    return likely
