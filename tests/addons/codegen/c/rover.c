/**
 * The flight app of the paper's first demo, in the manner of its figures: a Twist to the robot, a PoseStamped to the
 * ground.
 */
#include "app.h"

#include <edoras_core/interface.h>

typedef struct {
    CFE_MSG_TelemetryHeader_t TlmHeader;
    uint8_t data[100];
} PoseData_t;

static PoseData_t tlm_pose;
double twist[6];
double pose[7];
int32_t pose_sec;
uint32_t pose_nanosec;

void AppInit(void)
{
    CFE_MSG_Init(&tlm_pose.TlmHeader.Msg, CFE_SB_ValueToMsgId(0x0827), sizeof(tlm_pose));
}

static void to_robot(double x, double y, double z, double roll, double pitch, double yaw)
{
    const double values[6] = {x, y, z, roll, pitch, yaw};

    memcpy(twist, values, sizeof(values));
}

void AppCommand(CFE_SB_Buffer_t *SBBufPtr)
{
    const TypeInfo_t *const ti = get_type_info("geometry_msgs", "Twist");
    const TypeSupport_t *const ts = get_type_support("geometry_msgs", "Twist", NULL);
    size_t buffer_size;
    uint8_t *const msg = from_uint_buffer_to_msg_pointer((uint8_t *)SBBufPtr, 8, ts, ti, &buffer_size);
    double linear[3], angular[3];

    get_float64(msg, ti, "linear.x", &linear[0]);
    get_float64(msg, ti, "linear.y", &linear[1]);
    get_float64(msg, ti, "linear.z", &linear[2]);
    get_float64(msg, ti, "angular.x", &angular[0]);
    get_float64(msg, ti, "angular.y", &angular[1]);
    get_float64(msg, ti, "angular.z", &angular[2]);
    to_robot(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2]);
    free(msg);
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
    debug_parse_buffer(msg, ti);
    buffer = from_msg_pointer_to_uint_buffer(msg, ts, ti, &size);
    printBuffer(buffer, size, "to the ground: ");
    memcpy(tlm_pose.data, buffer, size);
    CFE_SB_TimeStampMsg(&tlm_pose.TlmHeader.Msg);
    CFE_SB_TransmitMsg(&tlm_pose.TlmHeader.Msg, true);
    free(msg);
    free(buffer);
    return done;
}

void AppHousekeeping(void)
{
    (void)RoverTelemetry();
}

const void *AppOutput(size_t *size)
{
    *size = sizeof(twist);
    return twist;
}
