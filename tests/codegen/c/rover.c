/**
 * The flight app of the paper's first demo, in the manner of its figures; it gives its memory back with free(), as
 * apps for edoras_core do, and is compiled with EDORAS_REPLACE_FREE.
 */
#include <stdlib.h>

#include <edoras_core/interface.h>

#include "cfe.h"

typedef struct {
    CFE_MSG_TelemetryHeader_t TlmHeader;
    uint8_t data[100];
} PoseData_t;

static PoseData_t tlm_pose;
double twist[2];
double pose[7];
int32_t pose_sec;
uint32_t pose_nanosec;

void RoverInit(void)
{
    CFE_MSG_Init(&tlm_pose.TlmHeader.Msg, CFE_SB_ValueToMsgId(0x0827), sizeof(tlm_pose));
}

bool RoverCommand(CFE_SB_Buffer_t *SBBufPtr)
{
    const TypeInfo_t *const ti = get_type_info("geometry_msgs", "Twist");
    const TypeSupport_t *const ts = get_type_support("geometry_msgs", "Twist", NULL);
    size_t buffer_size;
    uint8_t *const msg = from_uint_buffer_to_msg_pointer((uint8_t *)SBBufPtr, 8, ts, ti, &buffer_size);
    const bool read = get_float64(msg, ti, "linear.x", &twist[0]) && get_float64(msg, ti, "angular.z", &twist[1]);

    free(msg);
    return read && (buffer_size == ti->size_of_);
}

bool RoverTelemetry(void)
{
    static const char *const names[7] = {
        "pose.position.x", "pose.position.y", "pose.position.z", "pose.orientation.x",
        "pose.orientation.y", "pose.orientation.z", "pose.orientation.w"};
    const TypeInfo_t *const ti = get_type_info("geometry_msgs", "PoseStamped");
    const TypeSupport_t *const ts = get_type_support("geometry_msgs", "PoseStamped", NULL);
    uint8_t *const msg = create_msg(ti);
    uint8_t *buffer;
    size_t size;
    bool done = true;

    for (size_t i = 0; i < 7; i++)
        done = set_float64(msg, ti, names[i], pose[i]) && done;
    done = set_int32(msg, ti, "header.stamp.sec", pose_sec) && done;
    done = set_uint32(msg, ti, "header.stamp.nanosec", pose_nanosec) && done;
    done = set_const_char(msg, ti, "header.frame_id", "world") && done;
    buffer = from_msg_pointer_to_uint_buffer(msg, ts, ti, &size);
    memcpy(tlm_pose.data, buffer, size);
    CFE_SB_TimeStampMsg(&tlm_pose.TlmHeader.Msg);
    CFE_SB_TransmitMsg(&tlm_pose.TlmHeader.Msg, true);
    free(msg);
    free(buffer);
    return done;
}
