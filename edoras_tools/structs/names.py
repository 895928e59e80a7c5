"""Field names of cFE's own structs, the same in the built-in layout and in one from debug information.

The names made from cFE's C members are aliases: filters, fields and expectations take both.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Final

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
