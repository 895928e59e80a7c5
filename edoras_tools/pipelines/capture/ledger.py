"""Counts per route: messages, rate, jitter, and missing messages."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.links import table
from edoras_tools.mission.tree import printable
from edoras_tools.model import NO_MSG_ID, OTHER, Columns, Finding, Link, PacketBatch, rate_hz
from edoras_tools.sessions.sequence import SequenceCounts, SequenceStream
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, by_value, changes, distinct_rows, order_by
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.links.doors import Site
    from edoras_tools.mission import Mission, Route
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs
    from edoras_tools.structs.bindings import Bound


LONGEST_NOTE: Final = 300
"""Characters of a note on a topic that cannot be read."""
_TOLD_NS: Final = MILLISECOND
"""Least jump back in time that a note reports: several capturing processors cause smaller ones."""
_HALF: Final = 20
_LARGE_NS: Final = 1 << 43
"""Larger intervals are squared and summed one by one; 130,000 squares of smaller ones fit into 64 bits."""
_LABELS: Final = [item.label for item in Finding]
_UNFIT: Final = Finding.CDR_INVALID | Finding.CDR_TOO_LONG
"""Findings of messages that are not of their route's type."""
_SAMPLES: Final = 8
"""Different messages kept for each route."""


@cache
def _bits(findings: int) -> tuple[tuple[np.uint32, str], ...]:
    """Return each finding's bit and name."""
    return tuple((np.uint32(item), item.label) for item in Finding(findings))


class Account(msgspec.Struct):
    """The counts of one stream: a MsgId (or SBN message type) of a processor of a spacecraft on a link.

    Attributes:
        link: link of the stream.
        processor_id: ProcessorID of the cFS.
        msg_id: MsgId; ``NO_MSG_ID`` for none.
        kind: the link's own message type; -1 for none.
        spacecraft: number of the spacecraft.
        route: index into the mission's routes; negative for none.
        count: number of messages.
        first_ns: time of the earliest message, ns.
        last_ns: time of the latest message, ns.
        newest_ns: time of the message that came last in the file, ns.
        interval_squares: sum of the squared intervals, ns squared; exact, so independent of the batches.
        longest_ns: longest interval between two messages, ns.
        sequences: sequence counts of each sender.
        bytes_min: size of the smallest message.
        bytes_max: size of the largest message.
        bytes: size of all messages together.
        findings: number of messages by finding.
        codes: commands by function code, if each has its own struct.
        pauses: number of further runs in which the stream began again.
        paused_ns: time between the runs, ns.
        pausing: whether the next message begins another run.
    """

    link: Link
    processor_id: int
    msg_id: int
    kind: int
    spacecraft: int
    route: int
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    newest_ns: int = 0
    interval_squares: int = 0
    longest_ns: int = 0
    sequences: list[SequenceStream] = msgspec.field(default_factory=list)
    bytes_min: int = 1 << 31
    bytes_max: int = 0
    bytes: int = 0
    findings: dict[str, int] = msgspec.field(default_factory=dict)
    codes: Counter[int] = msgspec.field(default_factory=Counter)
    pauses: int = 0
    paused_ns: int = 0
    pausing: bool = False

    @property
    def gaps(self) -> int:
        """Sequence counts that never came."""
        return sum(item.gaps for item in self.sequences)

    @property
    def duplicates(self) -> int:
        """Packets with a sequence count that had already come."""
        return sum(item.duplicates for item in self.sequences)

    @property
    def reordered(self) -> int:
        """Packets that came after a packet with a higher sequence count."""
        return sum(item.reordered for item in self.sequences)

    @property
    def rate_hz(self) -> float:
        """Messages per second between the first and the last of each run."""
        steps, span_ns = self._intervals
        return rate_hz(steps + 1, span_ns)

    @property
    def jitter_ms(self) -> float:
        """Standard deviation of the time between messages."""
        steps, span_ns = self._intervals
        if steps < 2:
            return 0.0
        return math.sqrt(max(0, steps * self.interval_squares - span_ns * span_ns)) / steps / MILLISECOND

    @property
    def _intervals(self) -> tuple[int, int]:
        """Number of intervals between two messages, and their sum, ns."""
        return self.count - 1 - self.pauses, self.last_ns - self.first_ns - self.paused_ns

    @property
    def key(self) -> tuple[int, ...]:
        """Key of the account, unique, in the order of table rows."""
        return self.spacecraft, int(self.link), self.msg_id, self.processor_id, self.kind

    def as_json(self) -> list[Any]:
        """Return plain values from which ``of_json`` makes an equal account."""
        values = [getattr(self, name) for name in _PLAIN]
        return [int(self.link), *values, [self.gaps, self.duplicates, self.reordered], self.findings]

    @classmethod
    def of_json(cls, values: list[Any]) -> Account:
        """Return the account for values of ``as_json``.

        Raises:
            ValueError: the values are not those of an account; also ``TypeError`` and ``AttributeError``.
        """
        link, *plain, (gaps, duplicates, reordered), findings = values
        numbers = dict(zip(_PLAIN, plain, strict=True))
        stream = SequenceStream(missing=gaps, repeated=duplicates, late=reordered, moved=True)
        if {*map(type, (link, *plain, gaps, duplicates, reordered, *findings.values()))} != {int}:
            raise ValueError("a count is a whole number")
        return cls(
            table.link(link), **numbers, spacecraft=FIRST_SPACECRAFT, sequences=[stream], findings=findings
        )


_UNSAID: Final = {"link", "spacecraft", "sequences", "findings", "codes", "pauses", "paused_ns", "pausing"}
_PLAIN: Final = [name for name in Account.__struct_fields__ if name not in _UNSAID]
"""Fields that are written as plain numbers; a recording that contains them has one spacecraft."""
_TOTALS: Final = "datagrams", "start_ns", "end_ns", "behind", "behind_ns"


class _UnfitMessages:
    """Samples of each route's messages that are not of its type, as CDR with encapsulation."""

    def __init__(self) -> None:
        self._samples: dict[int, dict[bytes, None]] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Keep samples from a batch."""
        unfit = columns.findings & np.uint32(_UNFIT) != 0
        if not unfit.any():
            return
        rows = np.flatnonzero(unfit & (columns.route >= 0) & (columns.cdr_length > 0))
        for route, places in by_value(columns.route[rows]):
            samples = self._samples.setdefault(route, {})
            for row in rows[places[: _SAMPLES - len(samples)]].tolist():
                start = int(columns.cdr_offset[row])
                samples[batch.data[start : start + int(columns.cdr_length[row])].tobytes()] = None

    def line(self, place: int, route: Route, count: int, types: TypeStore) -> str:
        """Return the line about a route of which no message is of its type.

        Args:
            place: index of the route in ``Mission.routes``.
            count: number of its messages.
        """
        from edoras_tools.ros.store import types_that_fit

        start = f"0 of {count:,} messages of {route.topic} fit {route.type}"
        samples, own_types = list(self._samples.get(place, ())), _packaged(route)
        fits = types_that_fit(types, samples, own=own_types) if samples else []
        if not fits:
            return f"{start}: a mission of another system? edoras mission draft makes one of a capture"
        others = f" and {plural(len(fits) - 1, 'other type')}" if len(fits) > 1 else ""
        whose = f" (of {own_types[fits[0]]}?)" if fits[0] in own_types else ""
        return (
            f"{start}; they fit {fits[0]}{whose}{others}: name their mission with -c, or edoras mission draft"
        )


def _packaged(route: Route) -> dict[str, str]:
    """Return the types that the packaged missions have for a route's MsgId on its link, and their files."""
    from importlib.resources import files

    from edoras_tools.mission import loads

    folder: Any = files("edoras_tools.samples") / "missions"
    types: dict[str, str] = {}
    for path in sorted(folder.iterdir(), key=lambda item: item.name):
        for other in loads({path.name: path.read_bytes()}).routes:
            if (other.msg_id, other.link, other.type != route.type) == (route.msg_id, route.link, True):
                types.setdefault(other.type, path.name)
    return types


class Ledger:
    """The accounts of a whole capture.

    Args:
        site: site of the decoder, if links count the contents of their datagrams; else None.
        sequences: sequence counts shared with other users of the same batches; by default own ones.
        structs: structs that name packets without a route.

    Attributes:
        followers: the links' own counts.
        sequences: sequence counts of the streams.
        listed: indices of routes that have a row even without a message.
        several: whether the mission or the capture has more than one spacecraft.
        taken_out: number of rows that are packets from transfer frames.
        behind: datagrams whose time is before that of the previous one.
        behind_ns: maximum by which the time runs back.
    """

    def __init__(
        self,
        mission: Mission,
        site: Site | None = None,
        sequences: SequenceCounts | None = None,
        structs: Structs | None = None,
    ) -> None:
        self.mission = mission
        self._structs = structs
        self.followers = table.LinkStates(lambda link: None if site is None else link.follow(site))
        self._counted: dict[Link, int] = {}
        """Number of a follower's sequence counts that already belong to accounts."""
        self.accounts: dict[tuple[int, ...], Account] = {}
        self.sequences = sequences or SequenceCounts()
        self._types = site.types if site is not None else None
        self._unfit = _UnfitMessages()
        self.listed: Sequence[int] = ()
        self.several = len(mission.spacecraft) > 1
        self._known = 0
        """Number of streams in ``sequences`` that already belong to accounts."""
        self.datagrams = 0
        self.taken_out = 0
        self.start_ns = 0
        self.end_ns = 0
        self.behind = 0
        self.behind_ns = 0
        self._newest_ns = 0

    def as_json(self) -> dict[str, Any]:
        """Return plain values from which ``adopt`` restores the counts, except the links' own counts."""
        accounts = [self.accounts[key].as_json() for key in sorted(self.accounts)]
        return {**{name: getattr(self, name) for name in _TOTALS}, "accounts": accounts}

    def adopt(self, text: str) -> bool:
        """Restore counts from JSON of another ledger; return whether they are valid for this mission."""
        try:
            values = json.loads(text)
            totals = [int(values[name]) for name in _TOTALS]
            accounts = [Account.of_json(item) for item in values["accounts"]]
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return False
        is_complete = sum(item.count for item in accounts) == totals[0]
        if not is_complete or not all(self._fits(item) for item in accounts):
            return False
        for name, value in zip(_TOTALS, totals, strict=True):
            setattr(self, name, value)
        self.accounts = {
            (int(item.link), item.processor_id, item.msg_id, item.kind, item.spacecraft): item
            for item in accounts
        }
        return True

    def _fits(self, account: Account) -> bool:
        """Return whether an account is possible in this mission."""
        return account.route < len(self.mission.routes) and NO_MSG_ID <= account.msg_id < 1 << 16

    def tally(self, batch: PacketBatch) -> None:
        """Count only the number and the times of a batch's datagrams."""
        if not len(batch):
            return
        low, high = int(batch.time_ns.min()), int(batch.time_ns.max())
        back = np.diff(batch.time_ns, prepend=self._newest_ns if self.datagrams else low) < 0
        if back.any():
            newest = np.maximum.accumulate(batch.time_ns)
            if self.datagrams:
                newest = np.maximum(newest, self.end_ns)
            self.behind += int(np.count_nonzero(back))
            self.behind_ns = max(self.behind_ns, int((newest - batch.time_ns).max()))
        self._newest_ns = int(batch.time_ns[-1])
        self.start_ns = min(self.start_ns, low) if self.datagrams else low
        self.end_ns = max(self.end_ns, high)
        self.datagrams += len(batch)
        self.taken_out += int(np.count_nonzero(batch.original_length < 0))

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Count a batch, and every stream in it."""
        self.tally(batch)
        if not len(batch):
            return
        # Messages of a recording without datagrams have no MsgId: their topic identifies the stream.
        own = table.message_kinds(columns, batch.length) if batch.recorded is None else columns.route
        order, fresh = self.sequences.order(batch, columns)
        # Only packets without a MsgId have several kinds on one link.
        if not (has_id := columns.msg_id[order] != NO_MSG_ID).all():
            unnamed = order[~has_id]
            kind = columns.link[unnamed].astype(np.uint32) << 9 | (own[unnamed] + 1).astype(np.uint16)
            kinds = columns.processor_id[unnamed], kind, columns.spacecraft[unnamed]
            ranked = order_by(*kinds)
            order = np.concatenate((unnamed[ranked], order[has_id]))
            fresh = np.concatenate((changes(ranked, *kinds), fresh[has_id]))
        starts = np.flatnonzero(fresh)
        first = order[starts]
        parts = columns.link, columns.processor_id, columns.msg_id, own, columns.spacecraft
        keys = (item[first].tolist() for item in parts)
        accounts = [
            self.accounts.get(key) or self._account(columns, key[-2], row)
            for key, row in zip(zip(*keys, strict=True), first.tolist(), strict=True)
        ]
        self._count(accounts, batch, columns, order, starts)
        stream = self.sequences.follow(batch, columns).stream
        if len(self.sequences.streams) > self._known:
            streams, first, _ = distinct_rows(stream)
            for index, row in zip(streams.tolist(), first.tolist(), strict=True):
                if index >= self._known:
                    account = self._account(columns, int(own[row]), row)
                    account.sequences.append(self.sequences.streams[index])
            self._known = len(self.sequences.streams)
        self._count_codes(columns)
        if self._types is not None:
            self._unfit.add(batch, columns)
        self._follow(batch, columns)

    def _count_codes(self, columns: Columns) -> None:
        """Count commands by function code, where the function code selects the struct."""
        for msg_id in self._structs.shared if self._structs else ():
            rows = np.flatnonzero(columns.msg_id == msg_id)
            parts = columns.spacecraft, columns.link, columns.processor_id, columns.function_code
            keys = np.stack([part[rows] for part in parts])
            _, first, counts = np.unique(keys, axis=1, return_index=True, return_counts=True)
            for row, count in zip(rows[first].tolist(), counts.tolist(), strict=True):
                self._account(columns, -1, row).codes[int(columns.function_code[row])] += count

    def _follow(self, batch: PacketBatch, columns: Columns) -> None:
        """Let links count; their sequence counts are added to the account of the link's datagrams."""
        for follower in self.followers.of(columns):
            follower.add(batch, columns)
        for link, follower in self.followers.by_link.items():
            counts, start = follower.counts(), self._counted.get(link, 0)
            if len(counts) > start:
                row = int(np.argmax(columns.link == link))
                self._account(columns, -1, row).sequences += counts[start:]
                self._counted[link] = len(counts)

    def separate(self) -> None:
        """Begin another run: rates, gaps and order start again."""
        for account in self.accounts.values():
            account.pausing = True
        self.sequences, self._known = SequenceCounts(), 0

    def summary(self) -> dict[str, Any]:
        """Return the links' own counts, for ``info --json``."""
        return {
            name: value
            for follower in self.followers.by_link.values()
            for name, value in follower.summary().items()
        }

    @property
    def notes(self) -> list[str]:
        """Notes on the figures, one line each."""
        if self.behind_ns < _TOLD_NS:
            return []
        unit = "message" if self.mission.recorded else "datagram"
        back = f"{plural(self.behind, unit)}, by up to {self.behind_ns / SECOND:.3f} s"
        order_note = (
            "jitter, gaps and reordered are counted in the file's order; edoras doctor sorts it first"
        )
        return [f"times run back at {back}: {order_note}"]

    @property
    def findings(self) -> dict[str, int]:
        """Datagrams by finding."""
        total = Counter[str]()
        for account in self.accounts.values():
            total.update(account.findings)
        return dict(total)

    @property
    def unread(self) -> list[str]:
        """Lines about unreadable messages of a recording, with number and reason, one for each topic."""
        return [
            printable(
                f"{self.mission.routes[account.route].topic}: {plural(account.count, 'message')}: {why}",
                LONGEST_NOTE,
            )
            for account in self.accounts.values()
            if self.mission.recorded and (why := self.mission.recorded[account.route].unread)
        ]

    def unfit(self) -> list[str]:
        """Return a line for each configured topic of which no message is of its type."""
        if self.mission.recorded or self._types is None:
            return []
        return [
            self._unfit.line(item.route, self._mission_of(item).routes[item.route], item.count, self._types)
            for _, item in sorted(self.accounts.items())
            if item.route >= 0 and sum(item.findings.get(each.label, 0) for each in _UNFIT) >= item.count > 0
        ]

    def _account(self, columns: Columns, kind: int, row: int) -> Account:
        parts = columns.link, columns.processor_id, columns.msg_id, columns.spacecraft
        link, processor_id, msg_id, spacecraft = (int(item[row]) for item in parts)
        key = link, processor_id, msg_id, kind, spacecraft
        if key not in self.accounts:
            self.several = self.several or key[-1] != FIRST_SPACECRAFT
            self.accounts[key] = Account(table.link(key[0]), *key[1:], int(columns.route[row]))
        return self.accounts[key]

    @staticmethod
    def _count(
        accounts: list[Account], batch: PacketBatch, columns: Columns, order: Integers, starts: Integers
    ) -> None:
        """Add times, sizes and findings; account ``i`` has the rows ``order[starts[i]:starts[i + 1]]``."""
        times, lengths, findings = batch.time_ns[order], batch.length[order], columns.findings[order]
        counts = np.diff(np.append(starts, len(order))).tolist()
        first, last = (each.reduceat(times, starts).tolist() for each in (np.minimum, np.maximum))
        begin, newest = times[starts].tolist(), times[np.append(starts[1:], len(order)) - 1].tolist()
        times_apart = np.diff(times, prepend=times[0])
        times_apart[starts] = 0
        longest = np.maximum.reduceat(times_apart, starts).tolist()
        squares = _squares(times_apart, starts)
        total = np.add.reduceat(lengths, starts, dtype=np.int64).tolist()
        smallest = np.minimum.reduceat(lengths, starts).tolist()
        largest = np.maximum.reduceat(lengths, starts).tolist()
        for index, account in enumerate(accounts):
            apart_ns = begin[index] - account.newest_ns if account.count else 0
            if account.pausing:
                account.paused_ns += apart_ns
                account.pauses, account.pausing, apart_ns = account.pauses + 1, False, 0
            account.interval_squares += squares[index] + apart_ns * apart_ns
            account.longest_ns = max(account.longest_ns, longest[index], apart_ns)
            account.first_ns = min(account.first_ns, first[index]) if account.count else first[index]
            account.last_ns = max(account.last_ns, last[index])
            account.newest_ns = newest[index]
            account.count += counts[index]
            account.bytes += total[index]
            account.bytes_min = min(account.bytes_min, smallest[index])
            account.bytes_max = max(account.bytes_max, largest[index])
        met = np.bitwise_or.reduceat(findings, starts)
        ends = np.append(starts[1:], len(order))
        for index in np.flatnonzero(met).tolist():
            totals, own = accounts[index].findings, findings[starts[index] : ends[index]]
            for bit, label in _bits(int(met[index])):
                totals[label] = totals.get(label, 0) + int(np.count_nonzero(own & bit))

    def routes(self) -> list[dict[str, Any]]:
        """Return a row for every stream, in the shape of ``info --json``: configured topics first."""
        accounts = sorted(
            self.accounts.values(),
            key=lambda item: (
                item.spacecraft,
                item.route < 0 and len(self._own(item)) != 1,
                item.link == OTHER,
                *item.key,
            ),
        )
        rows = [self._row(account) for account in accounts]
        observed = {account.route for account in accounts}
        silent = [
            Account(OTHER, 0, NO_MSG_ID, place, FIRST_SPACECRAFT, place, bytes_min=0)
            for place in self.listed
            if place not in observed
        ]
        return rows + [self._row(account) for account in silent]

    def _mission_of(self, account: Account) -> Mission:
        """Return the mission with the topics of an account's spacecraft."""
        return self.mission.of(account.spacecraft) if self.several else self.mission

    def _own(self, account: Account) -> Mapping[str, Bound]:
        """Return the layout structs that packets without a route may contain, by topic."""
        if account.route >= 0 or account.msg_id == NO_MSG_ID or self._structs is None:
            return {}
        structs = self._structs.under(self.mission.prefix(account.spacecraft))
        own = {item.topic: item for item in structs.own(account.msg_id)}
        present = {topic: item for topic, item in own.items() if item.key.function_code in account.codes}
        return present or own

    def _row(self, account: Account) -> dict[str, Any]:
        mission = self._mission_of(account)
        route: Route | Bound | None = mission.routes[account.route] if account.route >= 0 else None
        recorded = bool(self.mission.recorded)
        own = self._own(account)
        if route is None and len(own) == 1:
            (route,) = own.values()
        topics = {topic: account.codes[item.key.function_code or 0] for topic, item in own.items()}
        name = message_name(self.mission.msg_ids.standard(account.msg_id))
        name = name or ", ".join(item.name for item in own.values() if item is not route)
        if account.msg_id == NO_MSG_ID and account.link != OTHER:
            name = table.protocol(account.link).message_name(account.kind)
        return {
            "topic": route.topic if route else None,
            "type": (route.type or None) if route else None,
            "name": name or None,
            "link": None if recorded else account.link.label,
            **({"spacecraft": account.spacecraft} if self.several else {}),
            "processor_id": account.processor_id or None,
            "msg_id": f"0x{account.msg_id:04x}" if account.msg_id != NO_MSG_ID else None,
            "count": account.count,
            "rate_hz": round(account.rate_hz, 3),
            "jitter_ms": round(account.jitter_ms, 3),
            "gaps": None if recorded else account.gaps,
            "duplicates": None if recorded else account.duplicates,
            "reordered": None if recorded else account.reordered,
            "bytes": account.bytes,
            "bytes_min": account.bytes_min,
            "bytes_max": account.bytes_max,
            "findings": {label: account.findings[label] for label in _LABELS if label in account.findings},
            **({"topics": topics} if len(topics) > 1 else {}),
        }


def _squares(times_apart: Integers, starts: Integers) -> list[int]:
    """Return the exact sum of squares of each group of intervals, computed in two halves of bits."""
    large = np.flatnonzero((times_apart >= _LARGE_NS) | (times_apart <= -_LARGE_NS))
    small = times_apart
    if len(large):
        small = times_apart.copy()
        small[large] = 0
    high, low = small >> _HALF, small & (1 << _HALF) - 1
    sums = [np.add.reduceat(item, starts).tolist() for item in (high * high, high * low, low * low)]
    totals = [(a << 2 * _HALF) + (b << _HALF + 1) + c for a, b, c in zip(*sums, strict=True)]
    owners = np.searchsorted(starts, large, side="right") - 1
    for owner, apart_ns in zip(owners.tolist(), times_apart[large].tolist(), strict=True):
        totals[owner] += apart_ns * apart_ns
    return totals
