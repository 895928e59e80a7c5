"""Which datagrams a command reads: by link, MsgId, topic and filter, over columns."""

from __future__ import annotations

from datetime import date, datetime, time, timedelta, tzinfo
from functools import cache, partial
from typing import TYPE_CHECKING, Final, overload

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import NO_MSG_ID, Columns, Link, PacketBatch
from edoras_tools.older import UTC
from edoras_tools.pipelines.names import PacketKinds, packets_of
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.io import Choice
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.wire.arrays.order import Integers, Mask

_BEFORE_NS: Final = 3600 * SECOND
"""Longest time that a clock time without a date may be before the capture, or an end before the start; an
earlier clock time is one of the next day."""


class ClockTime(msgspec.Struct, frozen=True):
    """A clock time from the command line.

    Attributes:
        text: text as it was written.
        clock_ns: time since midnight, ns.
        day: date; None for the first such time of a capture.
        zone: time zone; None for this machine's zone.
    """

    text: str
    clock_ns: int
    day: date | None = None
    zone: tzinfo | None = UTC

    def first(self, earliest_ns: int) -> int:
        """Return the time, ns since 1970; without a date, the first such time not before ``earliest_ns``.

        Raises:
            ConfigError: the time cannot be given a date.
        """
        try:
            day = self.day or datetime.fromtimestamp(earliest_ns // SECOND, self.zone).date()
            time_ns = self._on(day)
            late = self.day is not None or time_ns >= earliest_ns
            return time_ns if late else self._on(day + timedelta(days=1))
        except (OverflowError, ValueError, OSError):
            raise ConfigError(
                f"{self.text}: the capture's times are no dates; give seconds after its start"
            ) from None

    def _on(self, day: date) -> int:
        seconds, rest = divmod(self.clock_ns, SECOND)
        clock = datetime.combine(day, time()) + timedelta(seconds=seconds)
        return int(clock.replace(tzinfo=self.zone).timestamp()) * SECOND + rest


class Period(msgspec.Struct, frozen=True):
    """The datagrams between two times; by default all.

    Attributes:
        start_ns: start in ns after the first datagram. With 0, datagrams with an earlier time than the first
            one are included.
        end_ns: end in ns after the first datagram, not included; 0 for none.
        start: clock time that replaces ``start_ns``; :meth:`since` resolves it.
        end: clock time that replaces ``end_ns``; :meth:`since` resolves it.
        length_ns: length of the period, in place of an end, ns; 0 for none.

    Raises:
        ConfigError: the end is not after the start.
    """

    start_ns: int = 0
    end_ns: int = 0
    start: ClockTime | None = None
    end: ClockTime | None = None
    length_ns: int = 0

    def __post_init__(self) -> None:
        if not (self.start or self.end) and self.end_ns and self.end_ns <= self.start_ns:
            raise ConfigError(
                "--end is not after --start; both count from the start of the capture, or are clock times"
            )

    def __bool__(self) -> bool:
        return bool(self.start_ns or self.end_ns or self.length_ns or self.start or self.end)

    def since(self, begin_ns: int) -> Period:
        """Return the period in ns after a capture's first datagram.

        The search for a clock time without a date begins one hour before the first datagram; for an end, one
        hour before the start.

        Raises:
            ConfigError: the end is not after the start, or not after the first datagram.
        """
        start_ns, end_ns = self.start_ns, self.end_ns
        if self.start:
            start_ns = max(0, self.start.first(begin_ns - _BEFORE_NS) - begin_ns)
        if self.length_ns:
            end_ns = start_ns + self.length_ns
        elif self.end:
            end_ns = self.end.first(begin_ns + start_ns - _BEFORE_NS) - begin_ns
            if end_ns <= 0:
                raise ConfigError(
                    f"--end {self.end.text} is before the capture, which begins at {_began(begin_ns)}"
                )
        return Period(start_ns, end_ns)

    @overload
    def holds(self, since_ns: int) -> bool: ...
    @overload
    def holds(self, since_ns: Integers) -> Mask: ...
    def holds(self, since_ns: int | Integers) -> bool | Mask:
        """Return which times, in ns after the first datagram, are in a period that ``since`` returned."""
        assert self.start is self.end is None, "since() knows when the clock shows these times"
        after = (since_ns >= self.start_ns) | (not self.start_ns)
        return after & ((since_ns < self.end_ns) | (not self.end_ns))


def outside(name: str, begin_ns: int, end_ns: int) -> CaptureError:
    """Return the error that a capture has no datagram in the chosen time."""
    lasts = f"its times go from 0 to {(end_ns - begin_ns) / SECOND:.3f} s, and 0 is {_began(begin_ns)}"
    return CaptureError(f"{name}: nothing between --start and --end; {lasts}")


def _began(begin_ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(begin_ns // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{begin_ns / SECOND:.3f} s after 1970"


class Selection(msgspec.Struct, frozen=True):
    """A selection of datagrams; an empty one selects all.

    Attributes:
        links: only these links.
        msg_ids: only these MsgIds, or names that tables show.
        topics: only these topics, shell patterns, or names that tables show.
        notable: only datagrams with one of these finding bits.
        where: only datagrams that pass this filter; the result of :meth:`over` applies it.
        announced: also the datagrams that announce selected DDS topics: a recording needs them to name the
            topics.
    """

    links: Sequence[Link] = ()
    msg_ids: Sequence[int | str] = ()
    topics: Sequence[str] = ()
    notable: int = 0
    where: str = ""
    announced: bool = False
    _filter: Where | None = None
    _packets_by_craft: Callable[[int], Sequence[PacketKinds]] | None = None

    def __bool__(self) -> bool:
        return bool(self.links or self.msg_ids or self.topics or self.notable or self.where)

    def __str__(self) -> str:
        words = [f"link={link.label}" for link in self.links]
        words += [f"msg_id={f'0x{item:04x}' if isinstance(item, int) else item}" for item in self.msg_ids]
        words += [f"topic={item}" for item in self.topics]
        words += ["findings"] * bool(self.notable)
        return " ".join(words + [f"where={self.where}"] * bool(self.where))

    def over(self, bench: Workbench) -> Selection:
        """Return the selection prepared for a workbench; errors in it are raised here.

        Raises:
            RouteError: a topic pattern or a name matches nothing.
            ConfigError: the filter has an error.
        """
        context = bench.columns.context
        if context.mission.recorded and (self.links or self.msg_ids):
            raise ConfigError(
                "--link and --msg-id select datagrams, and the recording has only messages: use --topic, "
                "--where, --start and --end"
            )
        by_craft = cache(partial(self._packets_named, context))
        by_craft(FIRST_SPACECRAFT)  # raises the errors that every spacecraft would raise
        selection = replace(self, _packets_by_craft=by_craft)
        if not self.where:
            return selection
        from edoras_tools.decode.filters.filter import Where

        return replace(selection, _filter=Where(self.where, context))

    def _packets_named(self, context: Context, spacecraft: int) -> Sequence[PacketKinds]:
        """Return the packets that the names stand for on a spacecraft: each spacecraft has its own topics."""
        groups = [[hex(item) if isinstance(item, int) else item for item in self.msg_ids], self.topics]
        packets = [
            PacketKinds.any(packets_of(name, context, spacecraft) for name in names)
            for names in groups
            if names
        ]
        return [item.with_announcements() for item in packets] if self.announced else packets

    @property
    def _packets(self) -> Sequence[PacketKinds]:
        return self.packets_of(FIRST_SPACECRAFT)

    def packets_of(self, spacecraft: int) -> Sequence[PacketKinds]:
        """Return the named packets of a spacecraft; only the result of :meth:`over` has them."""
        return self._packets_by_craft(spacecraft) if self._packets_by_craft else ()

    def mask(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows are selected, without applying the filter: bool (rows,)."""
        mask = np.ones(len(columns), bool)
        if self.links:
            mask &= np.isin(columns.link, [int(link) for link in self.links])
        for number in np.flatnonzero(np.bincount(columns.spacecraft)).tolist() if self._packets else ():
            others = columns.spacecraft != number
            for packets in self.packets_of(number):
                mask &= others | packets.mask(batch, columns)
        if self.notable:
            mask &= (columns.findings & np.uint32(self.notable)) != 0
        return mask

    def by_heads(self, mission: Mission) -> Choice | None:
        """Return a function that says by link and MsgId which datagrams may be selected; None if all may be.

        Only the result of :meth:`over` has it. DDS samples cannot be selected this way.
        """
        if not (self.links or self._packets) or any(key.port for item in self._packets for key in item.keys):
            return None
        links = np.zeros(256, bool)
        links[[int(link) for link in self.links] if self.links else slice(None)] = True
        groups = [
            np.array([*item.msg_ids(mission), *[NO_MSG_ID] * bool(item.kinds)], np.int32)
            for item in self._packets
        ]
        return lambda link, msg_id: np.logical_and.reduce(
            [links[link], *(np.isin(msg_id, ids) for ids in groups)]
        )

    def places(self) -> frozenset[int] | None:
        """Return the indices of the named routes, None without names; for a result of :meth:`over`."""
        return frozenset.intersection(*(item.routes for item in self._packets)) if self._packets else None

    def about(
        self,
        link: str | None,
        msg_id: int | None,
        mission: Mission,
        samples: str = "",
        spacecraft: int = FIRST_SPACECRAFT,
    ) -> bool:
        """Return whether a link's label and a MsgId are selected, without applying the filter.

        Args:
            link: label of the link; None for anything that is not about a single link.
            msg_id: MsgId; None for anything that is not about a single MsgId.
            samples: topic of DDS samples, which have no MsgId; else empty.
            spacecraft: number of the spacecraft.
        """
        if self.links and link not in {item.label for item in self.links}:
            return False
        if samples:
            return all(packets.has_sample_topic(samples) for packets in self._packets)
        return all(msg_id in packets.msg_ids(mission) for packets in self.packets_of(spacecraft))

    def rows(self, batch: PacketBatch, columns: Columns) -> Integers:
        """Return the indices of the selected rows; for a result of :meth:`over`, or an empty selection."""
        assert self._packets_by_craft or not self, "over() finds what names stand for, and the filter"
        rows = np.flatnonzero(self.mask(batch, columns))
        return rows if self._filter is None else rows[self._filter.mask(batch, columns, rows)]

    def apply(self, batch: PacketBatch, columns: Columns) -> tuple[PacketBatch, Columns]:
        """Return the selected rows of a batch and of its columns."""
        if not self:
            return batch, columns
        rows = self.rows(batch, columns)
        return batch.take(rows), columns.take(rows)
