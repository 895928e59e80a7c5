"""cFE's own structs have the same fields, built in or from debug information of headers as cFE has them."""

import shutil
import subprocess

import pytest

from edoras_tools.addons.debug_info.dwarf import DebugInfo
from edoras_tools.decode import Context
from edoras_tools.decode.filters.layers import MessageFieldFinder
from edoras_tools.structs import shipped_structs
from edoras_tools.structs.messages import aliased, field_name, parts, shown_name

SOURCE = """
#include <stdint.h>
typedef struct { uint8_t bytes[16]; } CFE_MSG_TelemetryHeader_t;
typedef struct { uint32_t Seconds, Subseconds; } CFE_TIME_SysTime_t;
typedef struct CFE_TBL_HousekeepingTlm_Payload {
    uint8_t CommandCounter, CommandErrorCounter;
    uint16_t NumTables, NumLoadPending, ValidationCounter;
    uint32_t LastValCrc;
    int32_t LastValStatus;
    _Bool ActiveBuffer;
    char LastValTableName[40];
    uint8_t SuccessValCounter, FailedValCounter, NumValRequests, NumFreeSharedBufs;
    uint32_t MemPoolHandle;
    CFE_TIME_SysTime_t LastUpdateTime;
    char LastUpdatedTable[40], LastFileLoaded[64], LastFileDumped[64], LastTableLoaded[40];
} CFE_TBL_HousekeepingTlm_Payload_t;
typedef struct { CFE_MSG_TelemetryHeader_t TelemetryHeader; CFE_TBL_HousekeepingTlm_Payload_t Payload; }
    CFE_TBL_HousekeepingTlm_t;
typedef struct {
    uint32_t ResourceId, Type;
    char Name[20], EntryPoint[20], FileName[64];
    uint32_t StackSize, AddressesAreValid;
    uint32_t CodeAddress, CodeSize, DataAddress, DataSize, BSSAddress, BSSSize, StartAddress;
    uint16_t ExceptionAction, Priority;
    uint32_t MainTaskId, ExecutionCounter;
    char MainTaskName[20];
    uint32_t NumOfChildTasks;
} CFE_ES_AppInfo_t;
typedef struct { CFE_ES_AppInfo_t AppInfo; } CFE_ES_OneAppTlm_Payload_t;
typedef struct { CFE_MSG_TelemetryHeader_t TelemetryHeader; CFE_ES_OneAppTlm_Payload_t Payload; }
    CFE_ES_OneAppTlm_t;
typedef struct { char AppName[20]; uint16_t EventID, EventType; uint32_t SpacecraftID, ProcessorID; }
    CFE_EVS_PacketID_t;
typedef struct { CFE_EVS_PacketID_t PacketID; char Message[122]; uint8_t Spare1, Spare2; }
    CFE_EVS_LongEventTlm_Payload_t;
typedef struct { CFE_MSG_TelemetryHeader_t TelemetryHeader; CFE_EVS_LongEventTlm_Payload_t Payload; }
    CFE_EVS_LongEventTlm_t;
CFE_TBL_HousekeepingTlm_t a;
CFE_ES_OneAppTlm_t b;
CFE_EVS_LongEventTlm_t c;
"""


def fields(layout, name):
    """What a struct's message has: names, and where each lies."""
    made = parts(layout, layout.structs[name], whole=True)
    return [(part.name, part.member.offset) for part in made if not part.name.startswith("spare")]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_a_layout_from_debug_information_has_the_built_in_fields(tmp_path):
    source, made = tmp_path / "cfe.c", tmp_path / "cfe.o"
    source.write_text(SOURCE)
    subprocess.run(["gcc", "-g", "-c", source, "-o", made], check=True)
    built_in = shipped_structs().all
    names = ("CFE_TBL_HousekeepingTlm", "CFE_ES_OneAppTlm", "CFE_EVS_LongEventTlm")
    read, made_of = DebugInfo(made).layout([f"{name}_t" for name in names], {}, "cfs_msgs")
    for name in names:
        (ours,) = [item for item in built_in if item.name == name]
        assert fields(read, made_of[f"{name}_t"]) == fields(ours.layout, ours.struct.name), name


def test_both_names_of_a_field_find_it():
    finder = MessageFieldFinder(Context())
    for path, shown in (
        ("er_log_index", "reset_log_index"),
        ("CFE_TBL_HousekeepingTlm.num_tables", "CFE_TBL_HousekeepingTlm.tables"),
        ("CFE_EVS_LongEventTlm.packet_id.event_id", "CFE_EVS_LongEventTlm.event_id"),
        ("app_data[2].app_message_squelched_counter", "app_data[2].messages_squelched"),
    ):
        first, second = (finder.of_structs(item) for item in (path, shown))
        assert len(first) == len(second) == 1
        assert (first[0].kind, first[0].dtype, first[0].doc) == (
            second[0].kind,
            second[0].dtype,
            second[0].doc,
        )
    assert finder.of_structs("er_log_indices") == []


@pytest.mark.parametrize(
    ("struct", "member", "shown"),
    [
        ("CFE_ES_HousekeepingTlm_Payload_t", "ERLogIndex", "reset_log_index"),
        ("CFE_ES_HousekeepingTlm_Payload_t", "HeapBytesFree", "heap_bytes_free"),
        ("MY_APP_HkTlm_t", "ERLogIndex", "er_log_index"),
        ("CFE_TIME_HousekeepingTlm_Payload_t", "SecondsMET", "met_seconds"),
    ],
)
def test_only_structs_of_cfe_have_names_of_their_own(struct, member, shown):
    assert shown_name(struct, member) == shown
    assert shown == field_name(member) or shown in aliased(field_name(member)) or "APP" in struct
