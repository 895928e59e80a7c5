"""One line per packet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools import words
from edoras_tools.model import NO_MSG_ID, Endpoint, Finding, Link
from edoras_tools.render.severity import EXPLANATIONS, Level, ranked
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import cells, clean, clip, clip_left, clip_middle, fit, fit_right
from edoras_tools.words import TimeFormat

if TYPE_CHECKING:
    from edoras_tools.decode.lines import PacketLine


class ColumnLines:
    """Prints blocks of rows under one line of titles; a column grows if a later block needs more room.

    Args:
        heads: titles of the columns.
        right: which columns are right-aligned.
        width: cells that no line exceeds; 0 for any.
        colour: whether to use ANSI styles.
    """

    def __init__(
        self, heads: Sequence[str], right: Sequence[bool], *, width: int = 0, colour: bool = False
    ) -> None:
        self._heads = heads
        self._right = right
        self._width = width
        self._paint = palette.Paint(colour)
        self._sizes: list[int] = []

    def lines(self, block: Sequence[Sequence[str]]) -> Iterator[str]:
        """Yield the lines of a block, the heads before the first.

        Args:
            block: a list of clean texts for every column.
        """
        needed = [max(map(cells, column), default=0) for column in block]
        first = not self._sizes
        before = self._sizes or [cells(head) for head in self._heads]
        self._sizes = [max(pair) for pair in zip(before, needed, strict=True)]
        if first:
            yield self._paint(self._line(self._heads), palette.STRONG)
        for row in zip(*block, strict=True):
            yield self._line(row)

    def _line(self, row: Sequence[str]) -> str:
        parts = []
        for text, size, right in zip(row, self._sizes, self._right, strict=True):
            space = " " * (size - cells(text))
            parts.append(space + text if right else text + space)
        line = "  ".join(parts).rstrip()
        return clip(line, self._width) if self._width else line


class _Widths(NamedTuple):
    """Cells of every column at one terminal width; 0 leaves a column out, and ``info`` gets the rest."""

    number: int
    time: int
    endpoints: int
    kind: int
    msg_id: int
    name: int
    length: int
    info: int
    gap: str


COLUMNS: Final = ("time", "ports", "packet", "msg_id", "topic", "bytes")
"""The columns that can be left out; the number and the message are always there."""
MESSAGE_COLUMNS: Final = ("time", "topic", "bytes")
"""Columns of messages without datagrams."""
LEAST_WITH_TYPE: Final = 64
"""Width from which a message's type is shown too, in cells."""
_ADDED_CELLS: Final = (8, 24)
"""Least and most cells of an added column."""
_TIME_CELLS: Final = {
    TimeFormat.RELATIVE: (9, 11, 11),
    TimeFormat.DELTA: (9, 11, 11),
    TimeFormat.UTC: (12, 15, 26),
    TimeFormat.EPOCH: (17, 17, 17),
}
_MOST_KNOWN: Final = 4096
_PORTS, _COMPACT, _FULL = 11, 27, 45
_KIND_CELLS: Final = 9
_SHORT_KINDS: Final = {"NO_MSG": "NONE", "HEARTBEAT": "BEAT", "ANNOUNCE": "ANNC", "DISCONNECT": "DISC"}
"""Short SBN message types, behind the link's name, for a column of ``_KIND_CELLS``."""


@lru_cache(maxsize=64)
def _widths(width: int, time_format: TimeFormat, names: tuple[str, ...], added: tuple[int, ...]) -> _Widths:
    """Return the widths of the shown columns, next to columns that were added."""
    narrow, medium, wide = _TIME_CELLS[time_format]
    columns = (7, wide, _FULL, 14, 6, 28, 5)
    if width < 64:
        topic = 0 if "packet" in names else 14  # without the column of packets only the topic identifies it
        columns = (5, narrow if width >= 48 else 0, 0, 7, 0, topic, 0)
    elif width < 100:
        columns = (5, narrow, 0, _KIND_CELLS, 6, width // 6 - 1, 4)
    elif width < 150:
        columns = (6, medium, _PORTS, _KIND_CELLS, 6, width // 6, 5)
    elif width < 190:
        columns = (7, medium, _COMPACT, _KIND_CELLS, 6, 24, 5)
    number, *rest = columns
    time, ports, kind, msg_id, name, length = widths = [
        cells if item in names else 0 for cells, item in zip(rest, COLUMNS, strict=True)
    ]
    gap = " " if width < 120 else "  "
    info = width - sum(cells + len(gap) for cells in (number, *widths, *added) if cells)
    return _Widths(number, time, ports, kind, msg_id, name, length, max(0, info), gap)


class PacketList:
    """Turns packets into lines that never exceed the terminal.

    Args:
        width: columns of the terminal, at least 20.
        colour: whether to use ANSI styles.
        names: MsgId to a name, for packets that neither a message nor a layer names.
        verbose: whether to show notes, besides warnings and errors.
        begin_ns: zero of relative times, ns since 1970; None: the first packet shown.
        columns: columns of ``COLUMNS`` to show, if they fit.
        added: titles of columns in front of the message, each with whether it is aligned right.
    """

    def __init__(
        self,
        width: int,
        *,
        colour: bool,
        time_format: TimeFormat = TimeFormat.RELATIVE,
        names: Mapping[int, str] | None = None,
        verbose: bool = False,
        begin_ns: int | None = None,
        columns: Sequence[str] = COLUMNS,
        added: Sequence[tuple[str, bool]] = (),
    ) -> None:
        self._names = names
        self._paint = palette.Paint(colour)
        self._time_format = time_format
        self._at_least = Level.NOTE if verbose else Level.WARNING
        self._first_ns = begin_ns
        self._previous_ns: int | None = None
        self._columns = tuple(columns)
        least, most = _ADDED_CELLS
        self._added = [(title, right, max(least, min(most, len(title)))) for title, right in added]
        self.resize(width)

    def count_from(self, begin_ns: int) -> None:
        """Set the zero of relative times, ns since 1970, unless it is set; 0: unknown."""
        self._first_ns = self._first_ns or begin_ns or None

    def resize(self, width: int) -> None:
        """Arrange the columns for another width; it holds for later lines."""
        self._width = max(20, width)
        cells = tuple(cells for *_, cells in self._added)
        self._widths = _widths(self._width, self._time_format, self._columns, cells)
        self._endpoints: dict[tuple[int, int], tuple[str, Endpoint, Endpoint]] = {}
        self._badges: dict[Finding, tuple[str, int]] = {}
        self._known: dict[tuple[Link, str, int, str], str] = {}

    def header(self) -> str:
        """Return the line of column names."""
        size = self._widths
        parts = [fit_right("No.", size.number)]
        if size.time:
            parts.append(fit_right("UTC" if self._time_format is TimeFormat.UTC else "Time", size.time))
        if size.endpoints == _FULL:
            parts.append(fit(f"{'Source':>21} → Destination", size.endpoints))
        elif size.endpoints:
            parts.append(fit("Ports" if size.endpoints == _PORTS else "Source → Destination", size.endpoints))
        parts += [fit("Packet", size.kind)] * bool(size.kind)
        parts += [fit("MsgId", size.msg_id)] * bool(size.msg_id)
        parts += [fit("Topic", size.name)] * bool(size.name)
        parts += [fit_right("Bytes" if size.length > 4 else "Len", size.length)] * bool(size.length)
        parts += [self._cell(title, place) for place, (title, *_) in enumerate(self._added)]
        parts.append("Message")
        return self._paint(clip(size.gap.join(parts), self._width), palette.STRONG)

    def _cell(self, text: str, place: int) -> str:
        """Return the text of an added column."""
        _, right, cells = self._added[place]
        return fit_right(_rounded(text, cells), cells) if right else fit(text, cells)

    def line(self, packet: PacketLine, previous_ns: int | None = None, values: Sequence[str] = ()) -> str:
        """Return a packet's line, without a line end.

        Args:
            packet: packet.
            previous_ns: time of the packet above; None: time of the packet of the previous call.
            values: values of the added columns, clean.
        """
        if previous_ns is not None:
            self._previous_ns = previous_ns
        size, paint, kind, msg_id = self._widths, self._paint, packet.kind, packet.msg_id
        name = packet.name or (self._names or {}).get(msg_id, "")

        gap, number = size.gap, str(packet.number).rjust(size.number)
        before = number
        if size.time:
            before += gap + self._time(packet.time_ns).rjust(size.time)
        if size.endpoints:
            before += gap + self._route(packet.source, packet.destination)
        if middle := self._identity(packet.link, kind, msg_id, name):
            before += gap
        after = gap + str(packet.length).rjust(size.length) if size.length else ""

        # A number or a length that is too long for its column is shown whole, and the message gets less room.
        room = size.info - (len(number) - size.number) - max(0, len(after) - len(gap) - size.length)
        for place, value in enumerate(values):
            after += gap + self._cell(value, place)
        badge, badge_width = self._badge(packet.findings, room)
        # For a packet with a name only, the column of names shows everything.
        summary = clean(packet.text) if packet.text != name else ""
        summary = clip(summary, room - badge_width)
        if not self._paint.colour:
            return f"{before}{middle}{after}{gap}{badge}{summary}".rstrip()
        colour = palette.layer("ros") if packet.type else packet.link.colour
        return (
            f"{paint(before, palette.DIM)}{paint(middle, colour)}"
            f"{paint(after, palette.DIM)}{gap}{badge}{summary}"
        ).rstrip()

    def _identity(self, link: Link, kind: str, msg_id: int, name: str) -> str:
        """Return the columns that identify the packet."""
        key = link, kind, msg_id, name
        cached = self._known.get(key)
        if cached is not None:
            return cached
        size = self._widths
        if size.kind <= _KIND_CELLS:
            kind = _SHORT_KINDS.get(kind, kind)
        parts = [fit(f"{link.name} {kind}", size.kind)] * bool(size.kind)
        if size.msg_id:
            parts.append(f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else " " * 6)
        if size.name:
            parts.append(fit(clip_middle(clean(name), size.name), size.name))
        text = size.gap.join(parts)
        if len(self._known) > _MOST_KNOWN:
            self._known.clear()
        self._known[key] = text
        return text

    def _time(self, time_ns: int) -> str:
        if self._first_ns is None:
            self._first_ns = time_ns
        previous, self._previous_ns = self._previous_ns, time_ns
        width = self._widths.time
        if self._time_format is TimeFormat.RELATIVE:
            return f"{(time_ns - self._first_ns) / 1e9:.6f}"[:width]
        if self._time_format is TimeFormat.DELTA:
            return f"{(time_ns - (time_ns if previous is None else previous)) / 1e9:.6f}"[:width]
        if self._time_format is TimeFormat.EPOCH:
            return f"{time_ns // 1_000_000_000}.{time_ns // 1000 % 1_000_000:06}"[:width]
        moment = words.utc(time_ns)
        return moment[:width] if width == len(moment) else moment[11 : 11 + width]

    def _route(self, source: Endpoint, destination: Endpoint) -> str:
        key = id(source), id(destination)  # hashing them would take as long as the rest of a line
        cached = self._endpoints.get(key)
        if cached is None:
            if len(self._endpoints) > _MOST_KNOWN:
                self._endpoints.clear()
            text = _endpoints(source, destination, self._widths.endpoints)
            cached = self._endpoints[key] = text, source, destination  # keeping them keeps the ids unique
        return cached[0]

    def _badge(self, findings: Finding, room: int) -> tuple[str, int]:
        """Return the painted findings that fit into half of the room, and the cells they take."""
        if not findings:
            return "", 0
        key = findings if room == self._widths.info else None
        if key in self._badges:
            return self._badges[key]
        badge = self._make_badge(ranked(findings, at_least=self._at_least), room)
        if key is not None:
            self._badges[key] = badge
        return badge

    def _make_badge(self, findings: list[Finding], room: int) -> tuple[str, int]:
        if not findings or room < 4:
            return "", 0
        painted, used = "", 0
        for index, item in enumerate(findings):
            explanation = EXPLANATIONS[item]
            label = clip(f"{explanation.severity.mark} {explanation.short}", room - 2)
            if index and used + 1 + len(label) > room // 2:
                more = f" +{len(findings) - index}"
                if used + len(more) <= room - 2:
                    painted += self._paint(more, palette.DIM)
                    used += len(more)
                break
            gap = " " if index else ""
            painted += gap + self._paint(label, explanation.severity.style)
            used += len(gap) + len(label)
        return painted + "  ", used + 2


def _endpoints(source: Endpoint, destination: Endpoint, width: int) -> str:
    if width == _PORTS:
        return fit(f"{source.port:>5}→{destination.port}", width)
    if width == _FULL:
        half = (width - 3) // 2
        sender, right = clip_left(clean(str(source)), half), clip_left(clean(str(destination)), half)
        return f"{fit_right(sender, half)} → {fit(right, half)}"
    if source.address == destination.address:
        ports = f" {source.port}→{destination.port}"
        return fit(clip_left(clean(source.address), width - len(ports)) + ports, width)
    half = (width - 1) // 2
    sender, right = clip_left(clean(str(source)), half), clip_left(clean(str(destination)), half)
    return fit(f"{sender}→{right}", width)


def _rounded(text: str, room: int) -> str:
    """Return a number with as many digits as fit into the room; other texts unchanged."""
    if len(text) <= room:
        return text
    try:
        value = float(text)
    except ValueError:
        return text
    rounded = (f"{value:.{digits}g}" for digits in range(room, 0, -1))
    return next((item for item in rounded if len(item) <= room), text)
