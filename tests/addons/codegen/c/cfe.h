/**
 * As much of cFE's interface as the apps of the tests use, with the types of cFE's own headers. cfe.c is behind it for
 * the apps of the paper (packets are sent to an array, mission time is what the test says), bus.c for a whole app.
 */
#ifndef CFE_H
#define CFE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

typedef uint8_t uint8;
typedef uint16_t uint16;
typedef uint32_t uint32;
typedef int32_t int32;
typedef int64_t int64;
typedef int32_t CFE_Status_t;
typedef size_t CFE_MSG_Size_t;
typedef uint8 CFE_MSG_FcnCode_t;
typedef uint32 CFE_SB_PipeId_t;

typedef struct {
    uint32 Value;
} CFE_SB_MsgId_t;

typedef struct {
    uint8 Priority;
    uint8 Reliability;
} CFE_SB_Qos_t;

typedef enum { CFE_MSG_Type_Invalid, CFE_MSG_Type_Cmd, CFE_MSG_Type_Tlm } CFE_MSG_Type_t;

enum { CFE_ES_RunStatus_APP_RUN = 1, CFE_ES_RunStatus_APP_EXIT, CFE_ES_RunStatus_APP_ERROR };
enum { CFE_EVS_EventFilter_BINARY };
enum { CFE_EVS_EventType_INFORMATION = 2, CFE_EVS_EventType_ERROR };

#define CFE_SUCCESS 0
#define CFE_SB_TIME_OUT ((CFE_Status_t)0xCA000001)
#define CFE_SB_NO_MESSAGE ((CFE_Status_t)0xCA000002)
#define CFE_SB_DEFAULT_QOS ((CFE_SB_Qos_t){0, 0})
#define CFE_SB_MSGID_WRAP_VALUE(value) {value}

static inline CFE_SB_MsgId_t CFE_SB_ValueToMsgId(uint32 Value)
{
    const CFE_SB_MsgId_t MsgId = {Value};

    return MsgId;
}

static inline uint32 CFE_SB_MsgIdToValue(CFE_SB_MsgId_t MsgId)
{
    return MsgId.Value;
}

/** The primary header (CCSDS 133.0-B, 4.1.3). */
typedef struct {
    uint8_t Byte[6];
} CFE_MSG_Message_t;

typedef struct {
    CFE_MSG_Message_t Msg;
    uint8_t Sec[2]; /* function code, checksum */
} CFE_MSG_CommandHeader_t;

typedef struct {
    CFE_MSG_Message_t Msg;
    uint8_t Time[6];
    uint8_t Spare[4];
} CFE_MSG_TelemetryHeader_t;

typedef union {
    CFE_MSG_Message_t Msg;
    uint64_t Align;
} CFE_SB_Buffer_t;

CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, CFE_MSG_Size_t Size);
CFE_Status_t CFE_MSG_GetSize(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_Size_t *Size);
CFE_Status_t CFE_MSG_GetFcnCode(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_FcnCode_t *FcnCode);
CFE_Status_t CFE_MSG_GetTypeFromMsgId(CFE_SB_MsgId_t MsgId, CFE_MSG_Type_t *Type);
bool CFE_SB_IsValidMsgId(CFE_SB_MsgId_t MsgId);
CFE_Status_t CFE_SB_CreatePipe(CFE_SB_PipeId_t *PipeIdPtr, uint16 Depth, const char *PipeName);
CFE_Status_t CFE_SB_SubscribeEx(CFE_SB_MsgId_t MsgId, CFE_SB_PipeId_t PipeId, CFE_SB_Qos_t Quality, uint16 MsgLim);
CFE_Status_t CFE_SB_ReceiveBuffer(CFE_SB_Buffer_t **BufPtr, CFE_SB_PipeId_t PipeId, int32 TimeOut);
CFE_Status_t CFE_EVS_Register(const void *Filters, uint16 NumEventFilters, uint16 FilterScheme);
CFE_Status_t CFE_EVS_SendEvent(uint16 EventID, uint16 EventType, const char *Spec, ...)
    __attribute__((format(printf, 3, 4)));
CFE_Status_t CFE_ES_WriteToSysLog(const char *SpecStringPtr, ...) __attribute__((format(printf, 1, 2)));
bool CFE_ES_RunLoop(uint32 *RunStatus);
void CFE_ES_ExitApp(uint32 ExitStatus);
void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr);
CFE_Status_t CFE_SB_TransmitMsg(CFE_MSG_Message_t *MsgPtr, bool IncrementSequenceCount);

#endif
