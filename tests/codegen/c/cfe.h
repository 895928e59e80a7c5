/**
 * As much of cFE as the figures of the EDORAS paper use, for tests: packets are sent to an array, and mission
 * time is what the test says.
 */
#ifndef CFE_H
#define CFE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

typedef int32_t int32;
typedef int32_t CFE_Status_t;
typedef uint16_t CFE_SB_MsgId_t;

#define CFE_SUCCESS 0
#define CFE_SB_ValueToMsgId(value) (value)
#define CFE_SB_MSGID_WRAP_VALUE(value) (value)

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

CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, size_t Size);
void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr);
CFE_Status_t CFE_SB_TransmitMsg(CFE_MSG_Message_t *MsgPtr, bool IncrementSequenceCount);

#endif
