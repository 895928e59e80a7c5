"""C structs as ROS messages: names that rosidl accepts, and the definitions.

The struct of a packet becomes a message whose first field is ``CfsHeader`` instead of cFE's header: it names
the packet and its sender. If the only other member is ``Payload``, the message has the members of the
payload. The members of a union become separate fields, read from the same bytes. Arrays of several dimensions
are flattened, texts become strings.

Field names of cFE's own structs are the same in the built-in layout and in one from debug information. The
names made from cFE's C members are aliases: filters, fields and expectations take both.

Bytes of a struct become the CDR of its message, for many packets at once. A struct of one length is compiled
to segments: blocks, whose bytes have fixed offsets in the CDR once the start is aligned, and texts, after
which the alignment has to be computed again. A block is filled with a few strided copies over all packets;
nothing runs in Python per packet.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from itertools import takewhile
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.links import ROWS, table
from edoras_tools.model import OTHER
from edoras_tools.ros.library import PRIMITIVES, Constant, Definition, MessageField, Shape
from edoras_tools.structs.shapes import OPEN, Basic, BasicKind, Member, Struct, StructLayout
from edoras_tools.wire.arrays import Integers, Octets, copy_rows, put_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray


HEADER_TYPE: Final = "CfsHeader"
HEADER_FIELDS: Final = (
    MessageField("processor_id", "uint32"),
    MessageField("msg_id", "uint16"),
    MessageField("sequence_count", "uint16"),
    MessageField("function_code", "uint8"),
    MessageField("link", "uint8"),
)
"""Fields of ``CfsHeader``, the first field of every message of a packet: SBN ProcessorID of the sender (0 if
the packet came without SBN), MsgId, packet sequence count, function code of a command, and the ``Link``."""
_UNPACKED: Final = frozenset({"payload", "appinfo"})
"""Names of a member whose own members become the fields, if it is the only content of a packet."""


class MessagePart(NamedTuple):
    """A member as part of a message.

    Attributes:
        name: name of the field.
        member: the member; its offset counts from the start of the packet's payload, or of the nested struct.
        open: whether it is a sequence that extends to the end of the packet.
    """

    name: str
    member: Member
    open: bool


def message_type_name(name: str) -> str:
    """Return a struct's name for rosidl: ``CFE_ES_HousekeepingTlm_t`` is ``CfeEsHousekeepingTlm``."""
    words = [item for item in name.removesuffix("_t").split("_") if item]
    text = "".join(item.capitalize() if item.isupper() else item[0].upper() + item[1:] for item in words)
    return text if text[:1].isalpha() else f"C{text}"


def unique(name: str, used: set[str]) -> str:
    """Return a name, with a number if it is already used, and mark it as used."""
    free, number = name, 2
    while free in used:
        free, number = f"{name}{number}", number + 1
    used.add(free)
    return free


def parts(layout: StructLayout, struct: Struct, *, whole: bool) -> list[MessagePart]:
    """Return the parts of a struct's message, in the order of the declaration.

    Args:
        whole: whether the struct is a packet: its header is left out, ``Payload`` is unpacked, and the last
            array may be open.
    """
    members: Iterable[Member] = struct.members
    shift = struct.header if whole else 0
    if whole:
        members_shown = [item for item in members if item.offset >= struct.header]
        while (
            len(members_shown) == 1
            and not members_shown[0].dims
            and members_shown[0].name.lower() in _UNPACKED
        ):
            inner = layout.structs.get(str(members_shown[0].type))
            if inner is None:
                break
            shift -= members_shown[0].offset
            members_shown, struct = list(inner.members), inner
        members = [inner for item in members_shown for inner in _inlined(layout, item)]
    used = {"header"} if whole else set()
    result = []
    for item in members:
        is_open = whole and not struct.union and item is struct.members[-1] and OPEN in item.dims
        is_open = is_open and bool(item.text or layout.size(item))  # elements of 0 bytes have no end
        if layout.size(item) * item.count == 0 and not is_open and not _empty(layout, item):
            continue
        name = unique(shown_name(struct.name, item.name), used)
        result.append(
            MessagePart(name, replace(item, offset=item.offset - shift) if shift else item, is_open)
        )
    return result


def _inlined(layout: StructLayout, member: Member) -> list[Member]:
    """Return a member itself, or the members of its struct if these replace it (``INLINED``)."""
    inner = layout.structs.get(str(member.type)) if member.name == INLINED and not member.dims else None
    if inner is None:
        return [member]
    return [replace(item, offset=member.offset + item.offset) for item in inner.members]


def _empty(layout: StructLayout, member: Member) -> bool:
    """Return whether a member is a struct without members; such a member still becomes a message."""
    return member.count > 0 and str(member.type) in layout.structs


class Described(msgspec.Struct, frozen=True):
    """A field of a message, and the C member that it is read from.

    Attributes:
        field: field of the message.
        part: part of the struct; None for the header.
        constants: names of the field's values.
    """

    field: MessageField
    part: MessagePart | None
    constants: tuple[Constant, ...]


def described(
    layout: StructLayout, struct: Struct, names: Mapping[str, str], *, whole: bool
) -> list[Described]:
    """Return the fields of a struct's message.

    Args:
        names: full type names of the header and of the structs that it uses, by name.
        whole: as in :func:`parts`.
    """
    has_header = whole and not layout.entries
    fields = [Described(MessageField("header", names[HEADER_TYPE]), None, ())] if has_header else []
    used: set[str] = set()
    for part in parts(layout, struct, whole=whole):
        kind, shape, size = _type(layout, part.member, names), Shape.SCALAR, 0
        if part.open and part.member.array:
            shape = Shape.SEQUENCE
        elif part.member.array:
            shape, size = Shape.ARRAY, part.member.count
        enum = layout.enumeration(part.member)
        constants = tuple(
            Constant(unique(f"{part.name}_{field_name(label)}".upper(), used), kind, value)
            for value, label in (enum.names.items() if enum else ())
            if enum is not None and enum.basic.holds(value)
        )
        fields.append(Described(MessageField(part.name, kind, 0, shape, size), part, constants))
    return fields


def definition(name: str, fields: Iterable[Described]) -> Definition:
    """Return the definition of a message."""
    fields = list(fields)
    constants = tuple(constant for item in fields for constant in item.constants)
    return Definition(name, tuple(item.field for item in fields), constants)


def definition_text(struct: Struct, fields: Iterable[Described]) -> str:
    """Return the ``.msg`` file of a struct's message, with the C member of each field."""
    kind = f"{'union' if struct.union else 'struct'} {struct.name}, {struct.size} bytes"
    lines = [f"# {kind}" + f"; bytes count from behind its header of {struct.header}" * bool(struct.header)]
    lines += [f"# {struct.doc}"] * bool(struct.doc)
    for item in fields:
        lines += [f"{constant.type} {constant.name}={constant.value}" for constant in item.constants]
        line = f"{item.field.type_text} {item.field.name}"
        if item.part is not None:
            member = item.part.member
            notes = [member_place(member), *filter(None, [member.doc])]
            line += f"  # {': '.join(notes)}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def member_place(member: Member) -> str:
    """Return the offset of a member and its name in C."""
    dims = "".join(f"[{size or ''}]" for size in member.dims)
    bits = f".{member.bit}, {member.bits} bit{'s' * (member.bits > 1)}" if member.bits else ""
    return f"byte {member.offset}{bits} {member.name}{dims}"


def header_definition(name: str) -> Definition:
    """Return the definition of the header."""
    own = [link for link in table.links() if link.label in ROWS and (link.packets or link.last_hop)]
    links = tuple(Constant(f"LINK_{link.label.upper()}", "uint8", int(link)) for link in (OTHER, *own))
    return Definition(name, HEADER_FIELDS, links)


def _type(layout: StructLayout, member: Member, names: Mapping[str, str]) -> str:
    if member.text:
        return "string"
    basic = layout.basic(member)
    return primitive(basic) if basic is not None else names[str(member.type)]


def primitive(basic: Basic) -> str:
    """Return the ROS type of a basic type."""
    if basic.kind is BasicKind.BOOL:
        return "bool"
    return "uint8" if basic.kind in {BasicKind.CHAR, BasicKind.BYTE} else str(basic)


_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_TABLE: Final = """
CFE_ES_HousekeepingTlm: CFECoreChecksum=cfe_checksum CFEMajorVersion=cfe_major CFEMinorVersion=cfe_minor
  OSALMajorVersion=osal_major OSALMinorVersion=osal_minor PSPMajorVersion=psp_major
  PSPMinorVersion=psp_minor SysLogBytesUsed=system_log_bytes_used SysLogSize=system_log_size
  SysLogEntries=system_log_entries SysLogMode=system_log_mode ERLogIndex=reset_log_index
  ERLogEntries=reset_log_entries RegisteredLibs=registered_libraries
CFE_EVS_AppTlmData: AppMessageSentCounter=messages_sent AppEnableStatus=enabled
  AppMessageSquelchedCounter=messages_squelched
CFE_EVS_HousekeepingTlm: MessageFormatMode=message_format MessageTruncCounter=messages_truncated
  OutputPort=output_ports LogFullFlag=log_full MessageSendCounter=messages_sent
CFE_SB_StatsTlm: MemInUse=memory_in_use PeakMemInUse=peak_memory_in_use MaxMemAllowed=max_memory_allowed
  SBBuffersInUse=buffers_in_use PeakSBBuffersInUse=peak_buffers_in_use PipeDepthStats=pipes
CFE_SB_HousekeepingTlm: MsgSendErrorCounter=message_send_error_counter
  MsgReceiveErrorCounter=message_receive_error_counter PipeOptsErrorCounter=pipe_options_error_counter
  MsgLimitErrorCounter=message_limit_error_counter MemPoolHandle=memory_pool_handle MemInUse=memory_in_use
  UnmarkedMem=unmarked_memory
CFE_TBL_HousekeepingTlm: NumTables=tables NumLoadPending=loads_pending ByteAlignPad1=spare
  LastValCrc=last_validation_crc LastValStatus=last_validation_status LastValTableName=last_validated_table
  SuccessValCounter=validation_success_counter FailedValCounter=validation_failure_counter
  NumValRequests=validation_request_counter NumFreeSharedBufs=free_shared_buffers
  MemPoolHandle=memory_pool_handle
CFE_TIME_DiagnosticTlm: AtToneMET=tone_met AtToneSTCF=tone_stcf AtToneDelay=tone_delay
  AtToneLatch=tone_latch AtToneLeapSeconds=tone_leap_seconds ClockStateAPI=clock_state
  TimeSinceTone=since_tone CurrentTAI=tai CurrentUTC=utc ClockSetState=clock_set ClockFlyState=flywheel
  ServerFlyState=server_flywheel Forced2Fly=forced_flywheel ToneSignalLatch=signal_latch
  ToneDataLatch=data_latch ToneIntCounter=tone_interrupt_counter
  ToneIntErrorCounter=tone_interrupt_error_counter LocalIntCounter=local_interrupt_counter
CFE_ES_AppInfo: AddressesAreValid=addresses_valid NumOfChildTasks=child_tasks
CFE_TIME_HousekeepingTlm: ClockStateAPI=clock_state SecondsMET=met_seconds SubsecsMET=met_subseconds
  SecondsSTCF=stcf_seconds SubsecsSTCF=stcf_subseconds Seconds1HzAdj=adjust_seconds
  Subsecs1HzAdj=adjust_subseconds SecondsDelay=adjust_seconds SubsecsDelay=adjust_subseconds
CI_LAB_HkTlm: EnableChecksums=checksums_enabled
"""
_SHOWN: Final[dict[str, dict[str, str]]] = {
    struct: dict(pair.split("=") for pair in members.split())
    for struct, members in re.findall(r"^(\w+):((?:\s+\w+=\w+)+)", _TABLE, re.MULTILINE)
}
"""Member name to field name, by cFE struct without ``_Payload`` and ``_t``, if the field has its own name."""


@lru_cache(maxsize=4096)
def field_name(name: str) -> str:
    """Return a member's name for rosidl: ``ERLogIndex`` is ``er_log_index``."""
    words: list[str] = []
    for part in filter(None, name.split("_")):
        for match in _WORD.finditer(part):
            if words and match[0].isdigit() and match.start():
                words[-1] += match[0]  # a number belongs to the word before it
            else:
                words.append(match[0].lower())
    text = "_".join(words)
    return text if text[:1].isalpha() else f"m_{text}"


@lru_cache(maxsize=4096)
def shown_name(struct: str, member: str) -> str:
    """Return the name of the field for a member of a struct."""
    names = _SHOWN.get(struct.removesuffix("_t").removesuffix("_Payload"), {})
    return names.get(member) or field_name(member)


def aliased(name: str) -> frozenset[str]:
    """Return the fields of cFE's structs for which ``name``, made from their members, is an alias."""
    return _ALIASES.get(name, frozenset())


def _aliases() -> dict[str, frozenset[str]]:
    aliases: dict[str, set[str]] = {}
    for members in _SHOWN.values():
        for member, field in members.items():
            aliases.setdefault(field_name(member), set()).add(field)
    return {alias: frozenset(names) for alias, names in aliases.items()}


_ALIASES: Final = _aliases()
INLINED: Final = "PacketID"
"""Member of cFE's event packets: a struct whose members replace it in the packet's own message."""


_CDR_LE: Final = bytes((0, 1, 0, 0))
_SIZES: Final = {"b": 1, "B": 1, "?": 1, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4, "q": 8, "Q": 8, "d": 8}
HEAD: Final = np.dtype([(item.name, "<u" + str(_SIZES[PRIMITIVES[item.type]])) for item in HEADER_FIELDS])
"""Header values of the message, which stand in front of the struct's bytes before the conversion."""


class Copy(msgspec.Struct, frozen=True):
    """A copy of bytes, with or without a change of byte order.

    Attributes:
        source: first byte, from the start of the head; the payload follows the head.
        target: first byte, from the start of the block.
        size: bytes to copy.
        turn: bytes of an element whose byte order is reversed; 1: no change.
    """

    source: int
    target: int
    size: int
    turn: int


class Bits(msgspec.Struct, frozen=True):
    """A bit-field or a boolean, read from a few bytes.

    Attributes:
        source: first byte that holds a part of it, from the start of the head.
        target: first byte, from the start of the block.
        size: bytes to read.
        width: bits of the value.
        shift: bits to the right of the value, in the number that these bytes are.
        into: bytes to write.
        signed: whether the value is in two's complement.
        truth: whether 1 is written for every value that is not 0.
        order: byte order of the member, ``<`` or ``>``.
    """

    source: int
    target: int
    size: int
    width: int
    shift: int
    into: int
    signed: bool = False
    truth: bool = False
    order: str = "<"


class Block(msgspec.Struct):
    """Bytes at fixed offsets from an aligned start.

    Attributes:
        alignment: alignment of its start, 1 to 8 bytes.
        size: bytes.
        copies: bytes that are copied.
        bits: values that are computed.
        constants: bytes that are the same in every message, by offset.
    """

    alignment: int
    size: int = 0
    copies: list[Copy] = msgspec.field(default_factory=list)
    bits: list[Bits] = msgspec.field(default_factory=list)
    constants: dict[int, bytes] = msgspec.field(default_factory=dict)


class StructText(msgspec.Struct, frozen=True):
    """A text: the characters up to the first NUL.

    Attributes:
        source: first byte, from the start of the head.
        size: bytes of the array.
    """

    source: int
    size: int


class StructLeaf(msgspec.Struct, frozen=True):
    """A single value or an array of basic values in a packet, for display.

    Attributes:
        path: names and indices, from the message down.
        member: member of the struct.
        start: first byte, from the start of the payload.
        end: one past the last byte.
    """

    path: tuple[str | int, ...]
    member: Member
    start: int
    end: int


class StructPlan:
    """The plan that converts the packets of one struct and one payload length.

    Args:
        layout: the layout that the struct belongs to.
        struct: the struct.
        length: bytes of the payload, without the header.

    Attributes:
        width: bytes of the input row: the head, then the payload.
        leaves: every value and where it is.
        size: bytes of every message, encapsulation included; 0 if messages differ in size.

    Raises:
        ConfigError: the struct has more than ``MOST_VALUES`` values.
    """

    def __init__(self, layout: StructLayout, struct: Struct, length: int) -> None:
        self._layout = layout
        self._length = length
        self._segments: list[Block | StructText] = [Block(8)]
        self._known = 8  # the known alignment of the position, from the block's start
        self._copies = 0
        self.leaves: list[StructLeaf] = []
        self.width = HEAD.itemsize + length
        for item in () if layout.entries else HEADER_FIELDS:
            size = _SIZES[PRIMITIVES[item.type]]
            self._copy(HEAD.fields[item.name][1], size, size, "little")  # type: ignore[index]
        self._parts(struct, 0, (), whole=True)
        # After the first block comes a text, or a block whose offset depends on one.
        self.size = len(_CDR_LE) + self._block.size if len(self._segments) == 1 else 0

    def fill(self, rows: Octets, window: Octets) -> None:
        """Write messages; only if all have one ``size``.

        Args:
            rows: u8 (n, size), zeros.
            window: u8 (n, width), as in ``encode``.
        """
        rows[:, 1] = _CDR_LE[1]
        _fill(rows[:, len(_CDR_LE) :], self._block, window)

    def encode(self, window: Octets) -> tuple[Octets, Integers, Integers]:
        """Return the messages of many packets, encapsulation included.

        Args:
            window: u8 (n, width), a row a packet: a ``HEAD``, then the payload.

        Returns:
            u8, the messages one after the other; i64 (n,), offset of each; i64 (n,), bytes of each.
        """
        count = len(window)
        if self.size:
            rows = np.zeros((count, self.size), np.uint8)
            self.fill(rows, window)
            return rows.reshape(-1), np.arange(count) * self.size, np.full(count, self.size)
        cursor = np.zeros(count, np.int64)
        places = []
        texts: dict[int, tuple[Octets, Integers]] = {}
        for index, item in enumerate(self._segments):
            alignment = item.alignment if isinstance(item, Block) else 4
            cursor += -cursor % alignment
            places.append(cursor.copy())
            if isinstance(item, Block):
                cursor += item.size
            else:
                texts[index] = _texts(window[:, item.source : item.source + item.size])
                cursor += 4 + texts[index][1] + 1
        size = cursor + len(_CDR_LE)
        start = np.cumsum(size) - size
        out = np.zeros(int(size.sum()), np.uint8)
        body = start + len(_CDR_LE)
        if count:
            out[start + 1] = _CDR_LE[1]
        for index, (item, place) in enumerate(zip(self._segments, places, strict=True)):
            if isinstance(item, Block):
                if item.size:
                    rows = np.zeros((count, item.size), np.uint8)
                    _fill(rows, item, window)
                    put_rows(out, body + place, rows.view(f"V{item.size}")[:, 0])
                continue
            pool, length = texts[index]
            put_rows(out, body + place, (length + 1).astype("<u4"))
            offsets = np.arange(count) * item.size
            copy_rows(out, body + place + 4, pool, offsets, length)
        return out, start, size

    def _parts(self, struct: Struct, base: int, path: tuple[str | int, ...], *, whole: bool = False) -> None:
        members = parts(self._layout, struct, whole=whole)
        if not members and (not whole or self._layout.entries):
            self._constant(b"\0")  # an empty message is one byte on the wire
        for part in members:
            self._member(part.member, part.open, base, (*path, part.name))

    def _member(self, member: Member, is_open: bool, base: int, path: tuple[str | int, ...]) -> None:
        at, size = base + member.offset, self._layout.size(member)
        count = member.count
        if is_open:
            if member.text and len(member.dims) == 1:
                size = self._length - at
            else:
                count = max(self._length - at, 0) // (size * member.row) * member.row
                self._constant(count.to_bytes(4, "little"))
        basic = self._layout.basic(member)
        if member.text:
            for index in range(count):
                start = at + index * size
                where = (*path, index) if member.array else path
                self._append(StructText(HEAD.itemsize + start, size))
                self._leaf(where, member, start, start + size)
        elif basic is None:
            nested = self._layout.structs[str(member.type)]
            for index in range(count):
                where = (*path, index) if member.dims else path
                self._parts(nested, at + index * size, where)
        elif member.bits:
            self._bits(member, basic, at)
            self._leaf(path, member, at, at + (member.bit + member.bits + 7) // 8)
        else:
            self._basic(basic, at, count, "little" if self._layout.is_little(member) else "big")
            self._leaf(path, member, at, at + size * count)

    def _leaf(self, path: tuple[str | int, ...], member: Member, start: int, end: int) -> None:
        self.leaves.append(StructLeaf(path, member, start, end))

    def _basic(self, basic: Basic, at: int, count: int, order: str) -> None:
        if basic.kind is BasicKind.BOOL:
            for index in range(count):
                source = HEAD.itemsize + at + index * basic.size
                target = self._room(1, 1)
                self._block.bits.append(Bits(source, target, basic.size, 8 * basic.size, 0, 1, truth=True))
        elif count:
            self._copy(HEAD.itemsize + at, basic.size * count, basic.size, order)

    def _bits(self, member: Member, basic: Basic, at: int) -> None:
        size = (member.bit + member.bits + 7) // 8
        little = self._layout.is_little(member)
        shift = member.bit if little else 8 * size - member.bit - member.bits
        into = _SIZES[PRIMITIVES[primitive(basic)]]
        place = HEAD.itemsize + at, self._room(into, into), size, member.bits, shift, into
        signed, truth = basic.kind is BasicKind.INT, basic.kind is BasicKind.BOOL
        self._block.bits.append(Bits(*place, signed, truth, "<" if little else ">"))

    @property
    def _block(self) -> Block:
        last = self._segments[-1]
        assert isinstance(last, Block), "there is room in a block"
        return last

    def _room(self, size: int, alignment: int) -> int:
        """Reserve bytes in a block and return their offset; begin another block if alignment needs it."""
        self._copies += 1
        if self._copies > MOST_VALUES:
            raise ConfigError(f"a struct of more than {MOST_VALUES} values; bind a smaller one")
        last = self._segments[-1]
        if isinstance(last, StructText) or alignment > self._known:
            self._segments.append(Block(alignment))
            self._known = alignment
        block = self._block
        place = -(-block.size // alignment) * alignment
        block.size = place + size
        return place

    def _append(self, text: StructText) -> None:
        self._copies += 1
        if self._copies > MOST_VALUES:
            raise ConfigError(f"a struct of more than {MOST_VALUES} values; bind a smaller one")
        self._segments.append(text)

    def _constant(self, value: bytes) -> None:
        place = self._room(len(value), len(value))
        self._block.constants[place] = value

    def _copy(self, source: int, size: int, element: int, order: str) -> None:
        turn = element if order == "big" else 1
        target = self._room(size, element)
        copies = self._block.copies
        if copies and turn == copies[-1].turn:
            last = copies[-1]
            end = last.target + last.size
            # One copy may run over bytes that are written later, after all copies.
            joins = target == end or (turn == 1 and target - end == self._later(end))
            if joins and source - last.source == target - last.target:
                copies[-1] = replace(last, size=target - last.target + size)
                return
        copies.append(Copy(source, target, size, turn))

    def _later(self, start: int) -> int:
        """Return how many bytes of the block from ``start`` on are computed or constant, not copied."""
        block = self._block
        computed = ((item.target, item.into) for item in reversed(block.bits))
        constant = ((at, len(value)) for at, value in reversed(block.constants.items()))
        behind = (takewhile(lambda place: place[0] >= start, places) for places in (computed, constant))
        return sum(size for places in behind for _, size in places)


def _fill(out: Octets, block: Block, window: Octets) -> None:
    """Write a block of each packet into the rows of ``out``, u8 (n, size), which are zero."""
    for item in block.copies:
        source = window[:, item.source : item.source + item.size]
        if item.turn > 1:
            source = source.reshape(len(window), -1, item.turn)[:, :, ::-1].reshape(len(window), -1)
        out[:, item.target : item.target + item.size] = source
    for bits in block.bits:
        value = _read(bits, window)
        raw = value.astype(value.dtype.newbyteorder("<"), copy=False)[:, None].view(np.uint8)
        out[:, bits.target : bits.target + bits.into] = raw[:, : bits.into]
    for place, constant in block.constants.items():
        out[:, place : place + len(constant)] = np.frombuffer(constant, np.uint8)


def _read(bits: Bits, window: Octets) -> NDArray[np.unsignedinteger[Any]]:
    """Return the values of a bit-field, signs extended, in words large enough for source and target."""
    octets = window[:, bits.source : bits.source + bits.size]
    if bits.order == ">":
        octets = octets[:, ::-1]
    size = min(1 << (max(bits.size, bits.into) - 1).bit_length(), 8)
    word = np.dtype(f"u{size}").type
    value = np.zeros(len(window), word)
    for index in range(bits.size):
        octet, move = octets[:, index].astype(word), 8 * index - bits.shift
        value |= octet << word(move) if move >= 0 else octet >> word(-move)
    spare = 8 * size - bits.width
    if spare:
        value &= word((1 << bits.width) - 1)
    if bits.truth:
        value = np.minimum(value, word(1))
    if bits.signed and spare:
        extended = (value << word(spare)).view(f"i{size}") >> spare
        value = extended.view(word)
    return value


def _texts(field: Octets) -> tuple[Octets, Integers]:
    """Return all characters, a row the size of the array, and the length of each text up to its first NUL.

    Bytes that are not UTF-8 become ``?``.
    """
    count, size = field.shape
    pool = field.copy()
    ended = np.ones((count, size + 1), np.bool_)
    np.equal(pool, 0, out=ended[:, :size])
    length = ended.argmax(axis=1)
    beyond = pool >= 0x80  # ASCII stays valid UTF-8 wherever it is cut
    for row in np.flatnonzero(beyond.any(axis=1)).tolist() if beyond.any() else ():
        text = pool[row, : length[row]]
        try:
            text.tobytes().decode()
        except UnicodeDecodeError:
            pool[row, : length[row]] = np.where(text < 0x80, text, ord("?"))
    return pool.ravel(), length


MOST_VALUES: Final = 1 << 16
"""Most copies that one message may need; a struct with more is a mistake."""


class Counter:
    """Counts the copies that a struct needs in a message."""

    def __init__(self, layout: StructLayout) -> None:
        self._layout = layout
        self._known: dict[str, int] = {}

    def fixed(self, struct: Struct) -> int:
        """Return the copies for a packet, without an array that is open to the end."""
        members = parts(self._layout, struct, whole=True)
        return sum(self._of(part.member, part.member.count) for part in members if not part.open)

    def each(self, member: Member) -> int:
        """Return the copies for one element of an array that is open to the end."""
        return self._of(member, 2 * member.row) - self._of(member, member.row) if member.array else 0

    def _of(self, member: Member, count: int) -> int:
        basic = self._layout.basic(member)
        if basic is None:
            return count * self._nested(self._layout.structs[str(member.type)])
        return count if member.text or basic.kind is BasicKind.BOOL else 1

    def _nested(self, struct: Struct) -> int:
        if struct.name not in self._known:
            members = parts(self._layout, struct, whole=False)
            # An empty message is a byte.
            self._known[struct.name] = sum(self._of(part.member, part.member.count) for part in members) or 1
        return self._known[struct.name]
