"""The spacecraft of each datagram, and the headers that its packets have.

A spacecraft is the cFS at an address, which is one end of its links.

1. On a link towards cFS that end is the receiver, away from it the sender; of SBN it is the end that is no
   bridge. A datagram with no such end, or two, belongs to the spacecraft that sends it, else to the receiver.
2. Another address is another spacecraft if it sends packets of the same MsgIds that are no copies.
3. One cFS seen at two addresses (the same packets) is one; so are processors of one spacecraft on SBN.
4. For a file, all its packets decide: it is read once more when a second address comes. For a stream, the
   packets so far decide.
5. Numbers are in order of first sight, after those that a mission file names.

The headers of each packet, if one source holds conversations of several builds of cFE:

1. A conversation is all datagrams from one address and port to another. It is read with the headers detected
   for its packets (:mod:`edoras_tools.decode.variants`), or, if none were detected, with those of the whole
   source.
2. A conversation may hold packets of several builds, for example if a host ran one after the other. Then each
   packet has the first of these headers that explains it: known content starts after them. If none does, it
   has the first headers with which an app may accept it.
3. Where anything is detected, MsgIds are of version 1: version 2 is never detected from the bytes.

A conversation is identified by 16 bits of a hash, like everything that is looked up for each datagram.
"""

from __future__ import annotations

import ipaddress
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from zlib import crc32

import numpy as np

from edoras_tools.units import SECOND
from edoras_tools.wire import arrays, ccsds, cfe
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, Prints, distinct_rows, gather
from edoras_tools.wire.ccsds import MSG_ID_BYTES, VERSION_1, MsgIds
from edoras_tools.wire.envelope import DEFAULT, ENVELOPE_FORMATS, holds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.cfs import names
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.mission import Mission
    from edoras_tools.model import Datagram, Link, PacketBatch
    from edoras_tools.structs import Structs

FIRST_SPACECRAFT: Final = 1
_MOST: Final = 64
"""Most addresses of a file that are compared, those that sent most; all others count as the last of them."""
_RECEIVER, _SENDER, _PEER = 1, 2, 3
"""The end of a link that cFS is; for peers the ports decide."""
_HEAD: Final = 24
"""First bytes of a packet, with count and time: copies have the same."""
_COPIED_NS: Final = SECOND
"""Longest time from a packet to its copy."""
_IDENTITY: Final = "spacecraft_id", "processor_id"


class Spacecraft:
    """The spacecraft of a source, by number; they are found as its batches come.

    Args:
        mission: mission that names some of them.
        bridge_ports: ports of flight bridges, bool (65536,).

    Attributes:
        survey: reads the whole input once more for the number of each address; None if that is impossible.
        several: whether there is more than one.
        settled: whether the search for further ones has ended.
        numbers: number of each address so far, in the form of ``PacketBatch.fixed``.
    """

    def __init__(self, mission: Mission, links: Iterable[LinkProtocol], bridge_ports: Mask) -> None:
        self.survey: Callable[[], dict[int, int]] | None = None
        self.several = len(mission.spacecraft) > 1
        self._bridge_ports = bridge_ports
        self._side = np.zeros(256, np.uint8)
        for link in links:
            if link.packets and link.to_cfs != link.from_cfs:
                self._side[link] = _RECEIVER if link.to_cfs else _SENDER
            elif link.peers:
                self._side[link] = _PEER
        self._by_mission = {
            _fixed(address): number
            for number, (_, address) in enumerate(mission.spacecraft, FIRST_SPACECRAFT)
        }
        self.numbers = dict(self._by_mission)
        self.settled = False
        self._roles: dict[int, set[int]] = {}
        """Roles of cFS at each address of a stream; see ``_follow``."""
        self._rivals: defaultdict[int, Counter[int]] = defaultdict(Counter)
        """Number of addresses with each spacecraft number, by role, of a stream."""
        self._recent: list[tuple[int, Prints, Prints]] = []
        """Last time, packet prints and addresses of recent batches of a stream."""

    def ends(self, batch: PacketBatch, link: Octets) -> tuple[Octets, Prints]:
        """Return the end of each datagram that cFS is, u8, 0 for neither, and its address."""
        side = self._side.take(link)
        peers = np.flatnonzero(side == _PEER)
        if len(peers):
            to_bridge, from_bridge = (
                self._bridge_ports.take(port.take(peers))
                for port in (batch.destination_port, batch.source_port)
            )
            side[peers] = from_bridge * np.uint8(_RECEIVER) + to_bridge * np.uint8(_SENDER)
            side[peers[to_bridge == from_bridge]] = 0
        address = np.where(side == _RECEIVER, batch.destination_address, batch.source_address)
        return side, batch.fixed(address)

    def column(self, batch: PacketBatch, link: Octets, start: NDArray[np.int32]) -> Octets:
        """Return the spacecraft of each datagram, u8.

        Args:
            link: link of each datagram.
            start: start of the space packet in each, -1 if there is none.
        """
        first = np.full(len(batch), FIRST_SPACECRAFT, np.uint8)
        if self.settled and not self.several:
            return first
        side, address = self.ends(batch, link)
        rows = np.flatnonzero(side)
        moves: list[tuple[int, int, int]] = []
        if self.survey is not None:
            if len(self.numbers) == 1 and (address[rows] == next(iter(self.numbers))).all():
                return first
            self._look(address[rows])
        elif not self.settled and len(rows):
            prints = packet_prints(batch, rows, start[rows])
            role = side[rows].astype(np.uint64) << np.uint64(8) | link[rows]
            moves = self._follow(batch, rows, role, address[rows], prints)
        if not self.several:
            return first
        out = self._looked_up(address, FIRST_SPACECRAFT)
        for row, end, before in moves:
            out[:row][address[:row] == end] = before
        rest = np.flatnonzero(side == 0)
        sender, receiver = (
            self._looked_up(batch.fixed(end)[rest], 0)
            for end in (batch.source_address, batch.destination_address)
        )
        out[rest] = np.where(sender, sender, np.maximum(receiver, FIRST_SPACECRAFT))
        return out

    def of(self, datagram: Datagram, link: Link) -> int:
        """Return the spacecraft of one datagram, by the datagrams so far."""
        if not self.several:
            return FIRST_SPACECRAFT
        source, destination = (_fixed(end.address) for end in (datagram.source, datagram.destination))
        side = int(self._side[link])
        if side == _PEER:
            to_bridge, from_bridge = (
                bool(self._bridge_ports[end.port]) for end in (datagram.destination, datagram.source)
            )
            side = 0 if to_bridge == from_bridge else _RECEIVER if from_bridge else _SENDER
        if side:
            return self.numbers.get(destination if side == _RECEIVER else source, FIRST_SPACECRAFT)
        return self.numbers.get(source) or self.numbers.get(destination, FIRST_SPACECRAFT)

    def _look(self, addresses: Prints) -> None:
        """Find the spacecraft of a file, once a second address comes."""
        new = [item for item in dict.fromkeys(addresses.tolist()) if item not in self.numbers]
        if new and not self.numbers:
            self.numbers[new.pop(0)] = FIRST_SPACECRAFT
        if new and self.survey is not None:
            survey, self.survey = self.survey, None
            self.numbers, self.settled = survey(), True
            self._count()

    def _count(self) -> None:
        self.several = self.several or len({*self.numbers.values()}) > 1

    def _follow(
        self, batch: PacketBatch, rows: Places, roles: Prints, address: Prints, prints: Prints
    ) -> list[tuple[int, int, int]]:
        """Add the packets of cFS in a batch of a stream.

        Args:
            roles: role of each row: the end that cFS is, above the link. A relay of SBN is no rival of a cFS
                behind it that sends telemetry over TO.

        Returns:
            Each address whose number changed: the first row that has it, the address, and the number before.
        """
        self._recent = [item for item in self._recent if item[0] >= int(batch.time_ns[0]) - _COPIED_NS]
        self._recent.append((int(batch.time_ns[-1]), prints, address))
        moves, highest = [], max(self.numbers.values(), default=0)
        # Without a packet, nothing shows whether a datagram is a copy.
        roles = roles << np.uint64(1) | (prints != 0)
        for at in np.sort(np.unique(address << np.uint64(11) | roles, return_index=True)[1]).tolist():
            end, role = int(address[at]), int(roles[at])
            before, own = self.numbers.get(end), self._roles.setdefault(end, set())
            if role in own:
                continue
            others = self._rivals[role]
            number = before or FIRST_SPACECRAFT
            if (sender := self._sender_of(int(prints[at]), end, at)) is not None:
                # Equal commands may be meant for two; telemetry has a count and a time.
                sends = role >> 9 == _SENDER
                number = self.numbers[sender] if sends else before or self.numbers[sender]
            elif others[number] and end not in self._by_mission and (role & 1 or before is None):
                number = min(highest + 1, _MOST)
            for item in own:
                self._rivals[item][before or 0] -= 1
            own.add(role)
            for item in own:
                self._rivals[item][number] += 1
            self.numbers[end], highest = number, max(highest, number)
            if before not in {None, number}:
                moves.append((int(rows[at]), end, before or FIRST_SPACECRAFT))
        self._count()
        return moves

    def _sender_of(self, own_print: int, address: int, place: int) -> int | None:
        """Return another address that had this packet shortly before, up to a row of the newest batch."""
        for age, (_, prints, addresses) in enumerate(reversed(self._recent)):
            alike = (prints == np.uint64(own_print)) & (addresses != np.uint64(address))
            if own_print and alike[: len(alike) if age else place].any():
                return int(addresses[alike.argmax()])
        return None

    def _looked_up(self, address: Prints, unknown: int) -> Octets:
        addresses = np.array(sorted(self.numbers), np.uint64)
        numbers = np.array([self.numbers[item] for item in addresses.tolist()], np.uint8)
        place = np.minimum(np.searchsorted(addresses, address), len(addresses) - 1)
        return np.where(addresses[place] == address, numbers[place], np.uint8(unknown))


class Survey:
    """The evidence about spacecraft in the whole input.

    Args:
        spacecraft: spacecraft of a context of the same mission, which know the end that is cFS, and names.
    """

    def __init__(self, spacecraft: Spacecraft) -> None:
        self._spacecraft = spacecraft
        self._met: dict[int, set[tuple[int, int]]] = {item: set() for item in spacecraft.numbers}
        """Identities of SBN at each address; the addresses are in order of first sight."""
        self._parts: list[_Packets] = []

    def add(
        self,
        batch: PacketBatch,
        columns: Mapping[str, NDArray[Any]],
        start: NDArray[np.int32],
        msg_ids: MsgIds,
    ) -> None:
        """Add a batch.

        Args:
            columns: columns from the links' own headers.
            start: start of the space packet in each datagram, -1 if there is none.
        """
        side, address = self._spacecraft.ends(batch, columns["link"])
        rows = np.flatnonzero(side)
        peers = rows[(columns["sbn_msg_type"][rows] >= 0) & (side[rows] == _SENDER)]
        head = gather(batch.data, batch.offset[rows] + np.maximum(start[rows], 0), MSG_ID_BYTES)
        msg_id = msg_ids.column(head, batch.length[rows] - start[rows])
        own = (start[rows] >= 0) & (msg_ids.is_command(msg_id) == (side[rows] == _RECEIVER))
        for item in address[rows[np.sort(np.unique(address[rows], return_index=True)[1])]].tolist():
            self._met.setdefault(item, set())
        names = np.stack([address[peers], *(columns[name][peers] for name in _IDENTITY)])
        for end, craft, processor in np.unique(names, axis=1).T.tolist():
            self._met[end].add((craft, processor))
        rows = rows[own]
        prints = packet_prints(batch, rows, start[rows])
        self._parts.append(_Packets(side[rows] == _SENDER, address[rows], msg_id[own], prints))

    def numbers(self) -> dict[int, int]:
        """Return the number of each address."""
        numbers = dict(self._spacecraft.numbers)
        if not (self._parts and self._met):
            return numbers
        sent, address, msg_id, prints = map(np.concatenate, zip(*self._parts, strict=True))
        telemetry = sent if sent.any() else ~sent
        ends, _, which = distinct_rows(address)
        count_of = dict(zip(ends.tolist(), np.bincount(which).tolist(), strict=True))
        ranked = sorted(self._met, key=lambda end: (end not in numbers, -count_of.get(end, 0)))
        compared = sorted(ranked[:_MOST], key=[*self._met].index)
        packets = {end: np.flatnonzero(telemetry & (address == end)) for end in compared}

        def same(end: int, other: int) -> bool | None:
            """Return whether two addresses belong to one cFS; None if nothing decides it."""
            mine, theirs = packets[end], packets[other]
            shared = mine[np.isin(msg_id[mine], msg_id[theirs])]
            if not len(shared):
                return None
            if 2 * np.count_nonzero(np.isin(prints[shared], prints[theirs])) >= len(shared):
                return True
            crafts = [{craft for craft, _ in self._met[item]} for item in (end, other)]
            return bool(crafts[0] & crafts[1]) and self._met[end].isdisjoint(self._met[other])

        for end in (end for end in compared if end not in numbers):
            # If several addresses have one number, the last one is compared.
            rivals = {numbers[other]: other for other in compared if other in numbers}
            answers = {number: same(end, other) for number, other in rivals.items()}
            one = [number for number, answer in answers.items() if answer]
            one += [number for number, answer in answers.items() if answer is None]
            numbers[end] = one[0] if one else min(max(numbers.values(), default=0) + 1, _MOST)
        return dict.fromkeys(self._met, numbers[compared[-1]]) | numbers


def split_topic(topic: str) -> tuple[str, str]:
    """Return the text after ``/sc_`` at the beginning of a topic (else empty), and the rest of the topic."""
    match = re.match(r"/?sc_([^/*?\[]+)(?=/)", topic)
    return (match[1], topic[match.end() :]) if match else ("", topic)


def _fixed(address: str) -> int:
    """Return an address in the form of ``PacketBatch.fixed``."""
    value = ipaddress.ip_address(address)
    return int(value) if value.version == 4 else crc32(value.packed) | 1 << 32


class _Packets(NamedTuple):
    """Packets in the direction of their kind: whether cFS sent each, address of cFS, MsgId, print."""

    sent: Mask
    address: Prints
    msg_id: NDArray[np.int32]
    prints: Prints


def packet_prints(batch: PacketBatch, rows: Places, start: NDArray[np.int32]) -> Prints:
    """Return a fingerprint of each packet's first bytes, u64; 0 if no packet starts."""
    length = np.where(start < 0, 0, np.clip(batch.length[rows] - start, 0, _HEAD))
    return arrays.of_bytes(batch.data, batch.offset[rows] + start, length)


class CommandTable:
    """The commands that apps accept, as arrays, to judge many commands at once.

    Args:
        commands: commands of each app by function code, by MsgId.
    """

    def __init__(self, commands: Mapping[int, Mapping[int, names.Command]]) -> None:
        self._app = np.zeros(65536, np.uint8)
        self._taken = np.zeros((len(commands) + 1, 128), bool)
        self._lengths = np.zeros((2, len(commands) + 1, 128), np.int32)
        for app, (msg_id, codes) in enumerate(commands.items(), 1):
            self._app[msg_id] = app
            for code, command in codes.items():
                self._taken[app, code] = True
                for choice, length in enumerate(
                    command.lengths * 2 if len(command.lengths) == 1 else command.lengths
                ):
                    self._lengths[choice, app, code] = length

    def judge(
        self, msg_id: NDArray[np.int32], code: NDArray[np.int16], length: NDArray[np.int32]
    ) -> tuple[Mask, Mask]:
        """Return which commands have a function code that their app rejects, and which a wrong length."""
        app = self._app[msg_id]
        one, other = self._lengths[:, app, code]
        unknown: Mask = (app != 0) & ~self._taken[app, code]
        misfit: Mask = (one != 0) & (length != one) & (length != other)
        return unknown, misfit

    def fits(self, msg_id: NDArray[np.int32], code: NDArray[np.int16], length: NDArray[np.int32]) -> Mask:
        """Return which commands an app accepts with exactly this length."""
        app = self._app[msg_id]
        one, other = self._lengths[:, app, code]
        return self._taken[app, code] & (one != 0) & ((length == one) | (length == other))


LOOKED_AT: Final = 48
"""Bytes of a packet that are examined: the largest header, the largest envelope, an encapsulation."""
PLACES: Final = 1 << 16
_MIX: Final = 0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D


class Fitting:
    """Tests which packets the headers of one build explain: known content starts after these headers.

    Args:
        head: first bytes of each space packet with a correct length field, u8 (n, 48).
        length: bytes of each packet, i64 (n,).
    """

    def __init__(self, structs: Structs, commands: CommandTable, head: Octets, length: Integers) -> None:
        self._structs = structs
        self._commands = commands
        self._head = head
        self._length = length
        self._msg_id = VERSION_1.column(head, length)
        self._starts: dict[int, Mask] = {}

    def by(self, headers: cfe.Headers) -> Mask:
        """Return which packets some headers explain."""
        command = VERSION_1.is_command(self._msg_id)
        out = np.zeros(len(command), bool)
        rows = np.flatnonzero(command & (self._length >= headers.command_bytes))
        # A command that its app rejects is no message, even if its bytes (of a name, say) look like an
        # envelope.
        allowed = self.allowed(headers) & self._payload_fits(headers.command_bytes)
        alone = self._commands.fits(*self._command(rows, headers))  # by its length
        if headers.extended:  # spare bytes must be 0: no-ops that only seem extended rarely have zeros there
            alone &= (self._head[rows, headers.start + cfe.COMMAND.size : headers.command_bytes] == 0).all(
                axis=1
            )
        out[rows] = allowed[rows] | alone
        rows = np.flatnonzero(~command & (self._length >= headers.telemetry_bytes))
        out[rows] = self._telemetry_fits(rows, headers)
        return out

    def allowed(self, headers: cfe.Headers) -> Mask:
        """Return which packets are commands that an app may accept, if they have these headers."""
        rows = np.flatnonzero(VERSION_1.is_command(self._msg_id) & (self._length >= headers.command_bytes))
        unknown, misfit = self._commands.judge(*self._command(rows, headers))
        out = np.zeros(len(self._msg_id), bool)
        out[rows] = ~unknown & ~misfit
        return out

    def _command(
        self, rows: Places, headers: cfe.Headers
    ) -> tuple[NDArray[np.int32], NDArray[np.int16], NDArray[np.int32]]:
        """Return MsgId, function code, and the length that each command has with the usual header."""
        code = headers.command.column("function_code", self._head[rows], headers.start).astype(np.int16)
        as_usual = self._length[rows] - headers.command_bytes + cfe.COMMAND_HEADER_BYTES
        return self._msg_id[rows], code, as_usual.astype(np.int32)

    def _telemetry_fits(self, rows: Places, headers: cfe.Headers) -> Mask:
        spare = cfe.TELEMETRY.by_name["spare"]
        low, high = ccsds.PRIMARY.size + spare.start, ccsds.PRIMARY.size + spare.end
        blank = (self._head[rows, low:high] == 0).all(axis=1)
        early = self._payload_fits(cfe.SHORT.telemetry_bytes)[rows]
        early &= ~self._payload_fits(cfe.STANDARD.telemetry_bytes)[rows]
        if headers is cfe.STANDARD:
            return np.asarray(blank & ~early)
        return np.asarray(early if headers is cfe.SHORT else ~blank & ~early)

    def _payload_fits(self, at: int) -> Mask:
        """Return which packets have known content at an offset; each offset is tested once."""
        if at in self._starts:
            return self._starts[at]
        body, length, structs = self._head[:, at : at + DEFAULT.size + 4], self._length - at, self._structs
        fits = self._starts[at] = np.zeros(len(length), bool)
        for item in ENVELOPE_FORMATS:
            fits |= holds(body, length, item)
        event = self._msg_id == cfe.EVENT_MSG_ID
        name = body[event, :4]
        exact = (length[event] >= cfe.EVENT.size - 2) & (length[event] <= cfe.EVENT.size)
        fits[event] = exact & (name >= ord(" ")).all(axis=1) & (name < 127).all(axis=1)
        rows = np.flatnonzero(structs.has[self._msg_id] & ~VERSION_1.is_command(self._msg_id) & ~event)
        _, first, which = distinct_rows(self._msg_id[rows].astype(np.int64) << 32 | self._length[rows])
        pairs = zip(self._msg_id[rows[first]].tolist(), length[rows[first]].tolist(), strict=True)
        bounds = ((structs.find(msg_id, None, size), size) for msg_id, size in pairs)
        fits[rows] = np.array([bound is not None and bool(bound.fits(size)) for bound, size in bounds])[which]
        return fits


class Builds:
    """The headers of each conversation.

    Args:
        usual: headers of the source as a whole.

    Attributes:
        usual: index in ``cfe.HEADERS`` of the headers of the source as a whole.
        several: whether some conversation has other headers.
    """

    def __init__(self, structs: Structs, commands: CommandTable, usual: cfe.Headers) -> None:
        self._known = structs, commands
        self._headers = np.zeros(PLACES, np.uint8)
        self.usual = cfe.HEADERS.index(usual)
        self.several = False

    def settle(self, usual: cfe.Headers, places: Places, headers: Octets) -> None:
        """Set the detected headers.

        Args:
            usual: headers of the source as a whole.
            places: places of conversations, see ``conversations``.
            headers: headers of each, u8: one bit for each of ``cfe.DETECTABLE``; 0 if none was detected.
        """
        self.usual = cfe.HEADERS.index(usual)
        self._headers[places] = headers
        self.several = bool(((self._headers != 0) & (self._headers != 1 << self.usual)).any())

    @property
    def state(self) -> tuple[int, bytes]:
        """The detected headers, for ``take_over``."""
        return self.usual, self._headers.tobytes() if self.several else b""

    def take_over(self, state: tuple[int, bytes]) -> None:
        """Take the detected headers from another object of this class."""
        self.usual, headers = state
        self.several = bool(headers)
        if headers:
            self._headers = np.frombuffer(headers, np.uint8).copy()

    def of_batch(self, batch: PacketBatch, offset: Integers, length: NDArray[np.int32]) -> Any:
        """Return the headers of each space packet of a batch, u8; one number if all have the same.

        Args:
            offset: start of each packet in the batch's data.
            length: bytes of each packet.
        """
        if not self.several:
            return np.uint8(self.usual)
        headers = self._headers[conversations(batch)]
        out = np.array([self.usual, 0, 1, 0, 2, 0, 1, 0], np.uint8)[headers]
        mixed = np.flatnonzero(np.array([False, False, False, True, False, True, True, True])[headers])
        if len(mixed):
            head = gather(batch.data, offset[mixed], LOOKED_AT)
            out[mixed] = self._each(head, length[mixed].astype(np.int64), headers[mixed])
        return out

    def of_packet(self, datagram: Datagram, packet: bytes) -> cfe.Headers:
        """Return the headers of the space packet in a datagram."""
        if not self.several:
            return cfe.HEADERS[self.usual]
        headers = int(self._headers[_conversation(datagram)])
        if headers & (headers - 1):
            head = np.frombuffer(packet[:LOOKED_AT].ljust(LOOKED_AT, b"\0"), np.uint8)[None]
            return cfe.HEADERS[
                int(self._each(head, np.array([len(packet)]), np.array([headers], np.uint8))[0])
            ]
        return cfe.HEADERS[headers >> 1 if headers else self.usual]

    def _each(self, head: Octets, length: Integers, allowed: Octets) -> Octets:
        """Return the first headers of each packet's conversation that explain it, or else that allow it."""
        out, fitting = np.full(len(allowed), self.usual, np.uint8), Fitting(*self._known, head, length)
        for fits in (fitting.allowed, fitting.by):
            for number, headers in reversed(list(enumerate(cfe.DETECTABLE))):
                out[fits(headers) & ((allowed >> number & 1) != 0)] = number
        return out


def conversations(batch: PacketBatch) -> Places:
    """Return the place of each datagram's conversation, below ``PLACES``; IPv6 has only its ports."""
    source, target = batch.source_address, batch.destination_address
    if not (fourth := batch.ip_version == 4).all():
        source, target = (np.where(fourth, item, np.uint32(0)) for item in (source, target))
    ports = batch.source_port.astype(np.uint32) << 16 | batch.destination_port
    parts = zip((source, target, ports), _MIX, strict=True)
    first, second, third = (item * np.uint32(factor) for item, factor in parts)
    return ((first ^ second >> np.uint32(7) ^ third) * np.uint32(_MIX[0]) >> np.uint32(16)).astype(np.intp)


def _conversation(datagram: Datagram) -> int:
    """Return the place of a datagram's conversation, as ``conversations`` does."""
    ends = datagram.source, datagram.destination
    source, target = (0 if ":" in end.address else int(ipaddress.IPv4Address(end.address)) for end in ends)
    parts = zip((source, target, ends[0].port << 16 | ends[1].port), _MIX, strict=True)
    first, second, third = ((item * factor) & 0xFFFFFFFF for item, factor in parts)
    return ((first ^ second >> 7 ^ third) * _MIX[0] & 0xFFFFFFFF) >> 16
