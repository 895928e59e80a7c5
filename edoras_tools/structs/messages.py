"""C structs as ROS messages: names that rosidl accepts, and the definitions.

The struct of a packet becomes a message whose first field is ``CfsHeader`` instead of cFE's header: it names
the packet and its sender. If the only other member is ``Payload``, the message has the members of the
payload. The members of a union become separate fields, read from the same bytes. Arrays of several dimensions
are flattened, texts become strings.

Field names of cFE's own structs are the same in the built-in layout and in one from debug information. The
names made from cFE's C members are aliases: filters, fields and expectations take both.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.links import ROWS, table
from edoras_tools.model import OTHER
from edoras_tools.ros.types.schema import Constant, Definition, MessageField, Shape
from edoras_tools.structs.shapes import OPEN, Basic, BasicKind, Member, Struct, StructLayout

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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
