#include "cfe.h"

/* What a test sets, and what it looks at. */
uint32_t mission_seconds;
uint16_t mission_subseconds;
uint16_t sequence_count;
uint8_t transmitted[65542];
size_t transmitted_size;

static void put16(uint8_t *bytes, uint32_t value)
{
    bytes[0] = (uint8_t)(value >> 8);
    bytes[1] = (uint8_t)value;
}

CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, CFE_MSG_Size_t Size)
{
    memset(MsgPtr, 0, Size);
    put16(&MsgPtr->Byte[0], MsgId.Value);
    put16(&MsgPtr->Byte[2], 0xC000U);
    put16(&MsgPtr->Byte[4], (uint32_t)(Size - 7U));
    return CFE_SUCCESS;
}

void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr)
{
    uint8_t *const time = &MsgPtr->Byte[6];

    put16(&time[0], mission_seconds >> 16);
    put16(&time[2], mission_seconds & 0xFFFFU);
    put16(&time[4], mission_subseconds);
}

CFE_Status_t CFE_SB_TransmitMsg(CFE_MSG_Message_t *MsgPtr, bool IncrementSequenceCount)
{
    if (IncrementSequenceCount) {
        put16(&MsgPtr->Byte[2], 0xC000U | sequence_count);
    }
    transmitted_size = (((size_t)MsgPtr->Byte[4] << 8) | MsgPtr->Byte[5]) + 7U;
    memcpy(transmitted, MsgPtr, transmitted_size);
    return CFE_SUCCESS;
}
