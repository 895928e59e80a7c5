/**
 * A cFE of one app, in a time of its own: the app waits for a command until one is due or its wait ends. What it
 * publishes and reports is kept for the test.
 */
#include "cfe_psp.h"

#include <stdarg.h>
#include <stdio.h>

/* The test sets: when each command is due (us), where it lies; when all ends. */
int64 bus_due[16];
CFE_SB_Buffer_t bus_commands[16][16];
uint32 bus_command_count;
int64 bus_end;

/* The test looks at: packets one behind another, the time of each, events one a line, the last status. */
uint8 bus_published[1U << 23U];
size_t bus_published_size;
int64 bus_times[65536];
uint32 bus_published_count;
char bus_events[65536];
uint32 bus_subscribed, bus_subscribed_limit, bus_left_with;

static int64 now;
static uint32 next;

void CFE_PSP_GetTime(OS_time_t *LocalTime)
{
    LocalTime->ticks = now * 10;
}

bool CFE_ES_RunLoop(uint32 *RunStatus)
{
    return (*RunStatus == CFE_ES_RunStatus_APP_RUN) && (now < bus_end);
}

void CFE_ES_ExitApp(uint32 ExitStatus)
{
    bus_left_with = ExitStatus;
}

CFE_Status_t CFE_SB_CreatePipe(CFE_SB_PipeId_t *PipeIdPtr, uint16 Depth, const char *PipeName)
{
    *PipeIdPtr = (uint32)(Depth + strlen(PipeName));
    return CFE_SUCCESS;
}

CFE_Status_t CFE_SB_SubscribeEx(CFE_SB_MsgId_t MsgId, CFE_SB_PipeId_t PipeId, CFE_SB_Qos_t Quality, uint16 MsgLim)
{
    (void)PipeId;
    (void)Quality;
    bus_subscribed = MsgId.Value;
    bus_subscribed_limit = MsgLim;
    return CFE_SUCCESS;
}

CFE_Status_t CFE_SB_ReceiveBuffer(CFE_SB_Buffer_t **BufPtr, CFE_SB_PipeId_t PipeId, int32 TimeOut)
{
    const int64 until = now + ((int64)TimeOut * 1000);

    (void)PipeId;
    if ((next < bus_command_count) && (bus_due[next] <= until)) {
        now = (bus_due[next] > now) ? bus_due[next] : now;
        *BufPtr = bus_commands[next++];
        return CFE_SUCCESS;
    }
    now = until;
    return CFE_SB_TIME_OUT;
}

CFE_Status_t CFE_MSG_GetSize(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_Size_t *Size)
{
    *Size = (((size_t)MsgPtr->Byte[4] << 8) | MsgPtr->Byte[5]) + 7U;
    return CFE_SUCCESS;
}

CFE_Status_t CFE_MSG_GetFcnCode(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_FcnCode_t *FcnCode)
{
    *FcnCode = ((const CFE_MSG_CommandHeader_t *)MsgPtr)->Sec[0] & 0x7FU;
    return CFE_SUCCESS;
}

CFE_Status_t CFE_MSG_GetTypeFromMsgId(CFE_SB_MsgId_t MsgId, CFE_MSG_Type_t *Type)
{
    *Type = ((MsgId.Value & 0x1000U) != 0U) ? CFE_MSG_Type_Cmd : CFE_MSG_Type_Tlm;
    return CFE_SUCCESS;
}

bool CFE_SB_IsValidMsgId(CFE_SB_MsgId_t MsgId)
{
    return (MsgId.Value > 0U) && (MsgId.Value <= 0x1FFFU);
}

CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, CFE_MSG_Size_t Size)
{
    const size_t length = Size - 7U;
    uint8 *const bytes = MsgPtr->Byte;

    memset(MsgPtr, 0, Size);
    bytes[0] = (uint8)(MsgId.Value >> 8);
    bytes[1] = (uint8)MsgId.Value;
    bytes[2] = 0xC0;
    bytes[4] = (uint8)(length >> 8);
    bytes[5] = (uint8)length;
    return CFE_SUCCESS;
}

void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr)
{
    (void)MsgPtr;
}

CFE_Status_t CFE_SB_TransmitMsg(CFE_MSG_Message_t *MsgPtr, bool IncrementSequenceCount)
{
    CFE_MSG_Size_t size;

    CFE_MSG_GetSize(MsgPtr, &size);
    if (IncrementSequenceCount && (bus_published_size + size <= sizeof(bus_published))) {
        memcpy(&bus_published[bus_published_size], MsgPtr, size);
        bus_published_size += size;
        bus_times[bus_published_count++ & 0xFFFFU] = now;
    }
    return CFE_SUCCESS;
}

CFE_Status_t CFE_EVS_Register(const void *Filters, uint16 NumEventFilters, uint16 FilterScheme)
{
    return ((Filters == NULL) && (NumEventFilters == 0U) && (FilterScheme == CFE_EVS_EventFilter_BINARY)) ? 0 : -1;
}

CFE_Status_t CFE_EVS_SendEvent(uint16 EventID, uint16 EventType, const char *Spec, ...)
{
    const size_t used = strlen(bus_events);
    va_list values;
    int put = snprintf(&bus_events[used], sizeof(bus_events) - used, "%u %u ", (unsigned int)EventID, (unsigned int)EventType);

    va_start(values, Spec);
    put += vsnprintf(&bus_events[used + (size_t)put], sizeof(bus_events) - used - (size_t)put, Spec, values);
    va_end(values);
    (void)snprintf(&bus_events[used + (size_t)put], 2U, "\n");
    return CFE_SUCCESS;
}

CFE_Status_t CFE_ES_WriteToSysLog(const char *SpecStringPtr, ...)
{
    (void)SpecStringPtr;
    return CFE_SUCCESS;
}
