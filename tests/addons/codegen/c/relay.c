/**
 * The flight apps of the paper's third and fourth demo: what comes in under one MsgId goes out under another, to the
 * other side. TYPE is the name of the type, PACKAGE that of its package, ROOM the bytes of the packet's data.
 */
#include "app.h"

#include <edoras_core/interface.h>

typedef struct {
    CFE_MSG_TelemetryHeader_t TlmHeader;
    uint8_t data[ROOM];
} RelayData_t;

static RelayData_t relayed;
static bool received;

void AppInit(void)
{
    CFE_MSG_Init(&relayed.TlmHeader.Msg, CFE_SB_ValueToMsgId(0x082A), sizeof(relayed));
}

void AppCommand(CFE_SB_Buffer_t *SBBufPtr)
{
    const TypeInfo_t *const ti = get_type_info(PACKAGE, TYPE);
    const TypeSupport_t *const ts = get_type_support(PACKAGE, TYPE, NULL);
    size_t size;
    uint8_t *const msg = from_uint_buffer_to_msg_pointer((uint8_t *)SBBufPtr, 8, ts, ti, &size);
    uint8_t *const buffer = from_msg_pointer_to_uint_buffer(msg, ts, ti, &size);

    memset(relayed.data, 0, sizeof(relayed.data));
    for (size_t i = 0; i < size; i++)
        relayed.data[i] = buffer[i];
    received = true;
    free(msg);
    free(buffer);
}

void AppHousekeeping(void)
{
    if (received) {
        CFE_SB_TimeStampMsg(&relayed.TlmHeader.Msg);
        CFE_SB_TransmitMsg(&relayed.TlmHeader.Msg, true);
    }
    received = false;
}

const void *AppOutput(size_t *size)
{
    *size = sizeof(relayed.data);
    return relayed.data;
}
