/**
 * EDORAS_GEN: publishes telemetry at a rate, on command, so that "edoras sweep" can measure how much gets through.
 *
 * Function code 0 is a no-op. Function code 2 sets one of EDORAS_GEN_SLOTS slots; behind the command header five
 * numbers follow, each 16 bits, little-endian: slot, MsgId, rate in Hz (0 stops), kind, and the bytes of the message
 * behind its telemetry header. Kind 3 is a geometry_msgs/PoseStamped in an EDORAS envelope (8/8, little-endian), any
 * other kind is zeros.
 *
 * There is one task: it waits for a command no longer than until the next message is due. Nothing comes from a heap.
 */
#include "cfe.h"
#include "cfe_psp.h"

#include <string.h>

#include "edoras_gen_msgids.h"

#define EDORAS_GEN_SLOTS      8U
#define EDORAS_GEN_MAX_LENGTH 65520U /* what a packet can hold; the software bus says itself what is too long for it */
#define EDORAS_GEN_PIPE_DEPTH 32U
#define EDORAS_GEN_PIPE_LIMIT 32U /* a message limit of 4 would lose commands that come in one burst from CI */
#define EDORAS_GEN_POSE_KIND  3U
#define EDORAS_GEN_MAX_WAIT   1000 /* ms */

#define EDORAS_GEN_NOOP_CC 0
#define EDORAS_GEN_SET_CC  2

#define EDORAS_GEN_INIT_INF_EID 1
#define EDORAS_GEN_SLOT_INF_EID 2
#define EDORAS_GEN_CMD_ERR_EID  3
#define EDORAS_GEN_NOOP_INF_EID 4

typedef struct
{
    CFE_MSG_CommandHeader_t CommandHeader;
    uint8                   Payload[10];
} EDORAS_GEN_SetCmd_t;

typedef struct
{
    CFE_MSG_TelemetryHeader_t TelemetryHeader;
    uint8                     Data[EDORAS_GEN_MAX_LENGTH];
} EDORAS_GEN_Tlm_t;

typedef struct
{
    CFE_SB_MsgId_t MsgId;
    uint16         Rate; /* Hz; 0: the slot is idle */
    uint16         Kind;
    uint16         Length;
    uint32         Count;   /* messages published since the slot was set */
    int64          StartUs; /* when the first one was due */
} EDORAS_GEN_Slot_t;

void EDORAS_GEN_Main(void);

static EDORAS_GEN_Slot_t EDORAS_GEN_Slots[EDORAS_GEN_SLOTS];
static EDORAS_GEN_Tlm_t  EDORAS_GEN_Tlm;

/* A PoseStamped of frame "world" at the origin; the envelope is in front. */
static const uint8 EDORAS_GEN_Pose[100] = {
    84, 0, 0, 0, 0, 0, 0, 0, 84, 0, 0, 0, 0, 0, 0, 0, /* length, capacity */
    0, 1, 0, 0,                                       /* CDR, little-endian */
    0, 0, 0, 0, 0, 0, 0, 0,                           /* stamp */
    6, 0, 0, 0, 'w', 'o', 'r', 'l', 'd', 0, 0, 0, 0, 0, 0, 0, /* frame_id, padding */
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, /* x, y, z, qx */
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xF0, 0x3F                    /* qy, qz, qw */
};
#define EDORAS_GEN_POSE_STAMP 20U

static int64 EDORAS_GEN_Now(void)
{
    OS_time_t Now;

    CFE_PSP_GetTime(&Now);
    return OS_TimeGetTotalMicroseconds(Now);
}

static uint16 EDORAS_GEN_Get16(const uint8 *Bytes)
{
    return (uint16)(Bytes[0] | ((uint32)Bytes[1] << 8U));
}

static void EDORAS_GEN_Put32(uint8 *Bytes, uint32 Value)
{
    uint32 i;

    for (i = 0; i < 4U; i++)
    {
        Bytes[i] = (uint8)((Value >> (8U * i)) & 0xFFU);
    }
}

static void EDORAS_GEN_Publish(const EDORAS_GEN_Slot_t *Slot, int64 NowUs)
{
    CFE_MSG_Message_t *const Msg = &EDORAS_GEN_Tlm.TelemetryHeader.Msg;

    CFE_MSG_Init(Msg, Slot->MsgId, sizeof(EDORAS_GEN_Tlm.TelemetryHeader) + Slot->Length);
    if (Slot->Kind == EDORAS_GEN_POSE_KIND)
    {
        memcpy(EDORAS_GEN_Tlm.Data, EDORAS_GEN_Pose, sizeof(EDORAS_GEN_Pose));
        EDORAS_GEN_Put32(&EDORAS_GEN_Tlm.Data[EDORAS_GEN_POSE_STAMP], (uint32)(NowUs / 1000000));
        EDORAS_GEN_Put32(&EDORAS_GEN_Tlm.Data[EDORAS_GEN_POSE_STAMP + 4U], (uint32)(NowUs % 1000000) * 1000U);
    }
    CFE_SB_TimeStampMsg(Msg);
    CFE_SB_TransmitMsg(Msg, true);
}

/* Publish what is due in every slot; the result is how long nothing else is, in ms. */
static int32 EDORAS_GEN_Run(void)
{
    int64  Wait = (int64)EDORAS_GEN_MAX_WAIT * 1000;
    uint32 i;

    for (i = 0; i < EDORAS_GEN_SLOTS; i++)
    {
        EDORAS_GEN_Slot_t *const Slot  = &EDORAS_GEN_Slots[i];
        int64                    NowUs = EDORAS_GEN_Now();

        while (Slot->Rate != 0)
        {
            const int64 DueUs = Slot->StartUs + ((int64)Slot->Count * 1000000) / Slot->Rate;

            if (DueUs > NowUs)
            {
                Wait = ((DueUs - NowUs) < Wait) ? (DueUs - NowUs) : Wait;
                break;
            }
            EDORAS_GEN_Publish(Slot, NowUs);
            Slot->Count++;
        }
    }
    return (int32)((Wait + 999) / 1000);
}

static void EDORAS_GEN_Set(const EDORAS_GEN_SetCmd_t *Cmd)
{
    const uint16         Number = EDORAS_GEN_Get16(&Cmd->Payload[0]);
    const CFE_SB_MsgId_t MsgId  = CFE_SB_ValueToMsgId(EDORAS_GEN_Get16(&Cmd->Payload[2]));
    const uint16         Rate   = EDORAS_GEN_Get16(&Cmd->Payload[4]);
    const uint16         Kind   = EDORAS_GEN_Get16(&Cmd->Payload[6]);
    const uint16         Length = EDORAS_GEN_Get16(&Cmd->Payload[8]);
    CFE_MSG_Type_t       Type   = CFE_MSG_Type_Invalid;
    const char          *Reason = NULL;

    CFE_MSG_GetTypeFromMsgId(MsgId, &Type);
    if (Number >= EDORAS_GEN_SLOTS)
    {
        Reason = "there is no such slot";
    }
    else if ((Rate != 0) && (!CFE_SB_IsValidMsgId(MsgId) || (Type != CFE_MSG_Type_Tlm)))
    {
        Reason = "the MsgId is none of telemetry";
    }
    else if ((Rate != 0) && (Length > EDORAS_GEN_MAX_LENGTH))
    {
        Reason = "the message is too long";
    }
    else if ((Rate != 0) && (Kind == EDORAS_GEN_POSE_KIND) && (Length < sizeof(EDORAS_GEN_Pose)))
    {
        Reason = "a PoseStamped does not fit the length";
    }
    if (Reason != NULL)
    {
        CFE_EVS_SendEvent(EDORAS_GEN_CMD_ERR_EID, CFE_EVS_EventType_ERROR, "EDORAS_GEN slot %u refused: %s",
                          (unsigned int)Number, Reason);
    }
    else
    {
        EDORAS_GEN_Slot_t *const Slot = &EDORAS_GEN_Slots[Number];

        Slot->MsgId   = MsgId;
        Slot->Rate    = Rate;
        Slot->Kind    = Kind;
        Slot->Length  = Length;
        Slot->Count   = 0;
        Slot->StartUs = EDORAS_GEN_Now();
        CFE_EVS_SendEvent(EDORAS_GEN_SLOT_INF_EID, CFE_EVS_EventType_INFORMATION,
                          "EDORAS_GEN slot %u: MID 0x%04X kind %u len %u rate %u Hz", (unsigned int)Number,
                          (unsigned int)CFE_SB_MsgIdToValue(MsgId), (unsigned int)Kind, (unsigned int)Length,
                          (unsigned int)Rate);
    }
}

static void EDORAS_GEN_Command(const CFE_SB_Buffer_t *Buffer)
{
    CFE_MSG_FcnCode_t Code = 0;
    CFE_MSG_Size_t    Size = 0;

    CFE_MSG_GetFcnCode(&Buffer->Msg, &Code);
    CFE_MSG_GetSize(&Buffer->Msg, &Size);
    if ((Code == EDORAS_GEN_SET_CC) && (Size >= sizeof(EDORAS_GEN_SetCmd_t)))
    {
        EDORAS_GEN_Set((const EDORAS_GEN_SetCmd_t *)Buffer);
    }
    else if (Code == EDORAS_GEN_NOOP_CC)
    {
        CFE_EVS_SendEvent(EDORAS_GEN_NOOP_INF_EID, CFE_EVS_EventType_INFORMATION, "EDORAS_GEN no-op");
    }
    else
    {
        CFE_EVS_SendEvent(EDORAS_GEN_CMD_ERR_EID, CFE_EVS_EventType_ERROR,
                          "EDORAS_GEN command refused: function code %u, %lu bytes", (unsigned int)Code,
                          (unsigned long)Size);
    }
}

static CFE_Status_t EDORAS_GEN_Init(CFE_SB_PipeId_t *Pipe)
{
    const CFE_SB_MsgId_t Command = CFE_SB_ValueToMsgId(EDORAS_GEN_CMD_MID);
    CFE_Status_t         Status  = CFE_EVS_Register(NULL, 0, CFE_EVS_EventFilter_BINARY);

    memset(EDORAS_GEN_Slots, 0, sizeof(EDORAS_GEN_Slots));
    if (Status == CFE_SUCCESS)
    {
        Status = CFE_SB_CreatePipe(Pipe, EDORAS_GEN_PIPE_DEPTH, "EDORAS_GEN_PIPE");
    }
    if (Status == CFE_SUCCESS)
    {
        Status = CFE_SB_SubscribeEx(Command, *Pipe, CFE_SB_DEFAULT_QOS, EDORAS_GEN_PIPE_LIMIT);
    }
    if (Status == CFE_SUCCESS)
    {
        CFE_EVS_SendEvent(EDORAS_GEN_INIT_INF_EID, CFE_EVS_EventType_INFORMATION,
                          "EDORAS_GEN initialized, command MID 0x%04X", (unsigned int)EDORAS_GEN_CMD_MID);
    }
    else
    {
        CFE_ES_WriteToSysLog("EDORAS_GEN: cannot start, status 0x%08lX\n", (unsigned long)Status);
    }
    return Status;
}

void EDORAS_GEN_Main(void)
{
    CFE_SB_PipeId_t Pipe;
    uint32          RunStatus =
        (EDORAS_GEN_Init(&Pipe) == CFE_SUCCESS) ? CFE_ES_RunStatus_APP_RUN : CFE_ES_RunStatus_APP_ERROR;

    while (CFE_ES_RunLoop(&RunStatus))
    {
        CFE_SB_Buffer_t *Buffer = NULL;
        const int32      Wait   = EDORAS_GEN_Run();
        CFE_Status_t     Status = CFE_SB_ReceiveBuffer(&Buffer, Pipe, Wait);

        if (Status == CFE_SUCCESS)
        {
            EDORAS_GEN_Command(Buffer);
        }
        else if ((Status != CFE_SB_TIME_OUT) && (Status != CFE_SB_NO_MESSAGE))
        {
            RunStatus = CFE_ES_RunStatus_APP_ERROR;
        }
    }
    CFE_ES_ExitApp(RunStatus);
}
