"""Decides from the datagrams of a conversation whether it is cFS traffic.

A conversation is all datagrams from one address and port to another. Ports alone are not enough: other
programs use 1234 too, and a CI may use another port. The rules, in this order:

1. A datagram is *sound* for CI and TO if it begins with a space packet of version 0 with a secondary header,
   and its length agrees or its MsgId is known; for SBN if the message type is known and the size agrees. Of
   random datagrams, fewer than one in 10,000 is sound.
2. A conversation on a link's port is cFS traffic if at least 1 in 20 of its datagrams is sound, even if there
   are few.
3. Any other conversation whose destination is a cFS (sound datagrams go there too, or telemetry comes from
   that address) did reach it. It is the ground's if its source address also sends sound datagrams and most
   of its own begin like space packets; else it is ``STRANGER``.
4. Any other conversation on a link's port is not cFS traffic: ``FOREIGN``, left out and counted.
5. On a port of no link, a conversation looks like a link's if nearly all its datagrams are sound and have a
   correct length: ``UNNAMED``, and a note asks the user to name its port.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.links import table
from edoras_tools.model import OTHER, Columns, Endpoint, Finding, Link, PacketBatch
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.arrays import Integers, Mask, Places, distinct, gather, numbered
from edoras_tools.wire.ccsds import VERSION_1

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context

_SHARE: Final = 20
"""Datagrams of which one must be sound to make a conversation cFS's."""
_FEW: Final = 8
"""Most pairs of ports that are tested one by one."""
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)
_KNOWN_TYPES: Final = np.isin(np.arange(256), list(sbn.MsgType))
_BEGINNING: Final = 0xE800, 0x0800
"""Mask of the first word of a cFE packet, and its value: version 0, with a secondary header."""
_NO_MESSAGE: Final = Finding.SBN_SIZE_MISMATCH | Finding.SBN_UNKNOWN_TYPE | Finding.TRUNCATED


class ConversationKind(Enum):
    """The kind of traffic of a conversation."""

    CFS = "cFS"
    STRANGER = "stranger"
    FOREIGN = "foreign"
    UNNAMED = "unnamed"
    OTHER = "other"


LEFT_OUT: Final = frozenset({ConversationKind.FOREIGN, ConversationKind.STRANGER})
"""Kinds of conversations on a link's port that are not cFS traffic."""


class Flow(msgspec.Struct, eq=False):
    """All datagrams from one endpoint to another.

    Attributes:
        source: endpoint that sends.
        destination: endpoint that receives.
        link: link of the ports.
        datagrams: number of datagrams.
        first_ns: capture time of the first.
        last_ns: capture time of the last.
        begins: number that begin like the link's datagrams.
        sound: number that are sound.
        always_sound: whether it looked like its link's traffic after each datagram.
        commands: number with the length of a command, if it has no link.
        telemetry: number with the length of telemetry, if it has no link.
        network: number with the size of an SBN message, if it has no link.
        kind: kind of the traffic, by the datagrams so far.
    """

    source: Endpoint
    destination: Endpoint
    link: Link
    datagrams: int = 0
    first_ns: int = 0
    last_ns: int = 0
    begins: int = 0
    sound: int = 0
    always_sound: bool = True
    commands: int = 0
    telemetry: int = 0
    network: int = 0
    kind: ConversationKind = ConversationKind.OTHER

    @property
    def is_sound(self) -> bool:
        """Whether it looks like its link's traffic."""
        return self.sound * _SHARE >= self.datagrams

    @property
    def looks_like(self) -> Link:
        """The link whose traffic it looks like, if nearly all of it does; else ``OTHER``."""
        counts = self.commands, self.telemetry, self.network
        best = max(range(len(counts)), key=counts.__getitem__)
        links = (
            table.carrying("ground", to_cfs=True),
            table.carrying("ground", to_cfs=False),
            next(link for link in table.links() if link.peers),
        )
        return links[best] if counts[best] * 10 >= self.datagrams * 9 else OTHER


_SUMS: Final = ("begins", "sound", "commands", "telemetry", "network")


class Conversations(msgspec.Struct, eq=False):
    """All conversations of a source.

    Attributes:
        context: decoder context, with the known MsgIds.
        flows: flows by source and destination.
    """

    context: Context
    flows: dict[tuple[Endpoint, Endpoint], Flow] = msgspec.field(default_factory=dict)
    _last: tuple[Places, Places, list[Flow | None]] = msgspec.field(
        default_factory=lambda: (np.zeros(0, np.intp), np.zeros(0, np.intp), [])
    )

    def add(self, batch: PacketBatch, columns: Columns, mask: Mask | None = None) -> None:
        """Count the datagrams of a batch that a mask selects; None: all."""
        rows = np.flatnonzero(batch.length > 0 if mask is None else (batch.length > 0) & mask)
        link = columns.link
        marks = _marks(batch, columns, rows, self.context.known)
        first, which = numbered(conversation_of(batch)[rows])
        total = np.bincount(which, minlength=len(first))
        sound = marks["sound"]
        sums = {name: _count(which, marks[name], total) for name in _SUMS}
        sums["datagrams"] = total
        first_ns, last_ns = _spans(batch.time_ns[rows], first, which)
        # Other programs have many conversations; only those that look like a link's are kept.
        alike = link[rows[first]] != OTHER
        alike |= sums["commands"] + sums["telemetry"] + sums["network"] > 0
        flows: list[Flow | None] = []
        at = rows[first]
        each = (
            *(at, link[at], alike, first_ns, last_ns),
            *(sound[first].astype(np.intp), total - sums["sound"], *sums.values()),
        )
        for row, label, make, begin, end, sound_first, odd, *counts in zip(
            *(item.tolist() for item in each), strict=True
        ):
            flow = self._flow(batch, row, table.link(label), make=make)
            flows.append(flow)
            if flow is not None:
                flow.first_ns = min(flow.first_ns or begin, begin)
                flow.last_ns = max(flow.last_ns, end)
                # The unsound datagrams may come before all others of the batch.
                unsound = flow.datagrams - flow.sound + odd
                flow.always_sound &= (flow.sound + sound_first) * (_SHARE - 1) >= unsound
                for name, count in zip(sums, counts, strict=True):
                    setattr(flow, name, getattr(flow, name) + count)
        self._last = rows, which, flows

    def left_out(self) -> Places:
        """Return the rows of the last batch whose conversation is left out, by all its datagrams so far."""
        rows, which, flows = self._last
        if all(flow is None or flow.is_sound or not flow.link.packets for flow in flows):
            return rows[:0]  # takes the time of one batch; judging takes the time of all flows
        self.judge()
        return rows[np.array([flow is not None and flow.kind in LEFT_OUT for flow in flows], bool)[which]]

    def judge(self) -> list[Flow]:
        """Return all flows, each with its kind."""
        flows = list(self.flows.values())
        sound = [item for item in flows if item.link.packets and item.is_sound]
        speakers = {item.source.address for item in sound}
        reached = {item.destination for item in sound} | {item.source for item in sound if item.link.peers}
        hosts = {item.source.address for item in sound if item.link.from_cfs and not item.link.to_cfs}
        for flow in flows:
            to_host = not flow.link.from_cfs and flow.destination.address in hosts
            if flow.link is OTHER:
                flow.kind = ConversationKind.OTHER if flow.looks_like is OTHER else ConversationKind.UNNAMED
            elif flow.is_sound or not flow.link.packets:
                flow.kind = ConversationKind.CFS
            elif flow.destination in reached or to_host:
                own = flow.source.address in speakers and 2 * flow.begins >= flow.datagrams
                flow.kind = ConversationKind.CFS if own else ConversationKind.STRANGER
            else:
                flow.kind = ConversationKind.FOREIGN
        return flows

    def notes(self, *, keep_all: bool = False) -> list[str]:
        """Return notes for the user, a line each; ``keep_all``: foreign traffic is kept, not left out."""
        lines = foreign(self.judge())
        notes = [line.removesuffix(", left out") for line in lines] if keep_all else lines
        return [*map(str, unnamed(self.judge())), *notes]

    def recorded(self) -> list[str]:
        """Return a line for each port that looks like a link's but was recorded without messages."""
        return [f"{item.looks}, recorded without messages: {item.remedy}" for item in unnamed(self.judge())]

    @property
    def unnamed(self) -> int:
        """The number of datagrams that look like a link's, on ports that no option or recorder named."""
        listened = self.context.options.listened
        return sum(item.datagrams for item in unnamed(self.judge()) if item.port not in listened)

    def _flow(self, batch: PacketBatch, row: int, link: Link, *, make: bool) -> Flow | None:
        key = batch.ends(row)
        if make and key not in self.flows:
            self.flows[key] = Flow(*key, link)
        return self.flows.get(key)


def conversation_of(batch: PacketBatch) -> Integers:
    """Return a number that identifies each datagram's conversation: i64 (n,)."""
    ends = batch.source_address.astype(np.uint64) << np.uint64(32) | batch.destination_address
    ports = batch.source_port.astype(np.uint64) << np.uint64(16) | batch.destination_port
    # Mixed once more: ports that differ in their last bit differ in what is kept.
    return ((ends * _MIX ^ ports) * _MIX >> np.uint64(1)).astype(np.int64)


def in_doubt(batch: PacketBatch, columns: Columns, context: Context) -> Mask:
    """Return the datagrams of conversations that a batch leaves in doubt, bool: some in them are not sound.

    If fewer than one in 20 of a conversation is sound, all datagrams of its link are returned, because its
    kind depends on the link's other conversations.
    """
    link, packets = columns.link, table.accepted(lambda link: link.packets)
    _, sound = _soundness(columns, slice(None), context.known)
    odd = np.flatnonzero(~(sound | (batch.length == 0)) & packets.take(link))
    ports = batch.source_port.astype(np.uint32) << 16 | batch.destination_port
    pairs = distinct(ports[odd]).tolist()
    each = [ports == pair for pair in pairs[:_FEW]]
    if len(pairs) > _FEW or any(_SHARE * sound[own].sum() < own.sum() for own in each):
        return np.asarray(np.isin(link, distinct(link[odd])))
    return np.logical_or.reduce(each) if each else np.zeros(len(batch), np.bool_)


def foreign(flows: Iterable[Flow]) -> list[str]:
    """Return a line for each port whose traffic is left out because it is not cFS's."""
    counts: dict[int, int] = {}
    for flow in flows:
        if flow.kind in LEFT_OUT:
            counts[flow.destination.port] = counts.get(flow.destination.port, 0) + flow.datagrams
    return [
        f"{count:,} datagrams on port {port} do not look like cFS, left out"
        for port, count in sorted(counts.items())
    ]


class Unnamed(msgspec.Struct, frozen=True):
    """Traffic on a port that looks like a link's traffic, and that no option names."""

    port: int
    datagrams: int
    looks: str
    remedy: str

    @property
    def advice(self) -> str:
        """A text that names the traffic and says that it was not examined."""
        return f"{self.looks} and were left out"

    def __str__(self) -> str:
        """Return the text with its remedy, in one line."""
        return f"{self.advice}: {self.remedy}"


def unnamed(flows: Iterable[Flow]) -> list[Unnamed]:
    """Return an entry for each port whose traffic looks like a link's, and that no option names."""
    counts: dict[tuple[Link, int], int] = {}
    for flow in flows:
        if flow.kind is ConversationKind.UNNAMED:
            key = flow.looks_like, flow.destination.port
            counts[key] = counts.get(key, 0) + flow.datagrams
    return [
        Unnamed(
            port,
            count,
            f"{count:,} datagrams on port {port} look like {link.name} traffic",
            f"name the port with --set port={link.label}:{port}",
        )
        for (link, port), count in sorted(counts.items())
    ]


def _count(which: Places, marked: Mask, total: Places) -> Places:
    """Return how many rows of each group are marked, given the groups' sizes; mostly all, or none."""
    return total if marked.all() else np.bincount(which[marked], minlength=len(total))


def _spans(time_ns: Integers, first: Places, which: Places) -> tuple[Integers, Integers]:
    """Return the smallest time of each group, and the largest, at least 0; see ``numbered``."""
    if (time_ns[1:] >= time_ns[:-1]).all():  # nearly always
        last = np.zeros(len(first), np.intp)
        last[which] = np.arange(len(which))  # numpy keeps the last of several values for one place
        return time_ns[first], np.maximum(time_ns[last], 0)
    first_ns, last_ns = time_ns[first], np.zeros(len(first), np.int64)
    np.minimum.at(first_ns, which, time_ns)
    np.maximum.at(last_ns, which, time_ns)
    return first_ns, last_ns


def _marks(batch: PacketBatch, columns: Columns, rows: Places, described: Mask) -> dict[str, Mask]:
    """Return the marks of each of some datagrams, by the names of the counts in ``Flow``."""
    begins, sound = _soundness(columns, rows, described)
    marks = {"begins": begins, "sound": sound}
    other = np.flatnonzero(columns.link[rows] == OTHER)
    for name, mark in _alike(batch, rows[other]).items():
        marks[name] = np.zeros(len(rows), bool)
        marks[name][other] = mark
    return marks


def _soundness(columns: Columns, rows: Places | slice, described: Mask) -> tuple[Mask, Mask]:
    """Return which of some datagrams begin like their link's, and which are sound."""
    msg_id, findings = columns.msg_id[rows], columns.findings[rows]
    first = cfe.known_ids(msg_id, columns.headers[rows])
    begins = (msg_id >= 0) & ((first & _BEGINNING[0]) == _BEGINNING[1])
    mismatched = (findings & np.uint32(Finding.LENGTH_MISMATCH)) != 0
    sound = begins & (~mismatched | described.take(msg_id))
    peer = columns.sbn_msg_type[rows] >= 0
    begins |= peer & ((findings & np.uint32(Finding.SBN_UNKNOWN_TYPE)) == 0)
    sound |= peer & ((findings & np.uint32(_NO_MESSAGE)) == 0)
    return begins, sound


def _alike(batch: PacketBatch, rows: Places) -> dict[str, Mask]:
    """Return which datagrams of no link have the length of a link's datagrams, by link kind."""
    head = gather(batch.data, batch.offset[rows], sbn.HEADER.size)
    have = batch.length[rows].astype(np.int64)
    # Bytes that the capture cut off count as well: a frame has its original length.
    length = have + np.maximum(batch.original_length[rows] - batch.frame_length[rows], 0)
    word = head[:, 0].astype(np.int32) << 8 | head[:, 1]
    total = ccsds.PRIMARY.column("packet_data_length", head).astype(np.int64) + ccsds.LENGTH_BIAS
    agrees = (have >= ccsds.PRIMARY.size) & ((word & _BEGINNING[0]) == _BEGINNING[1]) & (total == length)
    command = VERSION_1.is_command(word)
    size = sbn.HEADER.column("msg_size", head).astype(np.int64)
    fits = (have >= sbn.HEADER.size) & (size == length - sbn.HEADER.size)
    fits |= (have >= sbn.LEGACY_HEADER.size) & (size == length - sbn.LEGACY_HEADER.size)
    return {
        "commands": agrees & command,
        "telemetry": agrees & ~command,
        "network": fits & _KNOWN_TYPES[sbn.HEADER.column("msg_type", head)],
    }
