"""The headers of each packet, if one source holds conversations of several builds of cFE.

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
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, distinct_rows, gather
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.envelope import DEFAULT, ENVELOPE_FORMATS, holds

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.cfs import names
    from edoras_tools.model import Datagram, PacketBatch
    from edoras_tools.structs import Structs


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
