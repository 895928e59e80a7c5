/**
 * The flight app of the paper's second demo. Figures 14, 15 and 16 stand here word for word, between their
 * markers; what the figures leave out ("snip") is filled in beside comments that say so.
 */
#include "app.h"

#include <edoras_core/interface.h>

#pragma GCC diagnostic ignored "-Wunused-parameter" /* Figure 16 has one */

#define EDORAS_APP_TLM_MID 0x0827

/* As the public app has them. */
typedef struct {
    const TypeInfo_t *ti;
    void *ts_library;
    const TypeSupport_t *ts;
} ParseData_t;

static ParseData_t parse_pose_;
static ParseData_t parse_joint_state_;
static size_t offset;

/* The robot of the test. */
static int commData;
double commanded[7];
double joints[7];
int32_t sec;
uint32_t nanosec;

static void sendPoseCmd(
    int *_comm, double _x, double _y, double _z, double _qx, double _qy, double _qz, double _qw)
{
    const double values[7] = {_x, _y, _z, _qx, _qy, _qz, _qw};

    (void)_comm;
    memcpy(commanded, values, sizeof(values));
}

/* Figure 14. */
void EdorasAppProcessGroundCommand(CFE_SB_Buffer_t *SBBufPtr)
{
    offset = 8;
    uint8_t* msg_pointer = NULL;
    size_t buffer_size;
    msg_pointer = from_uint_buffer_to_msg_pointer( (uint8_t*)SBBufPtr, offset,
                                                parse_pose_.ts, parse_pose_.ti, &buffer_size);

    // Get data
    double pos_x, pos_y, pos_z, orient_x, orient_y, orient_z, orient_w;
    get_float64(msg_pointer, parse_pose_.ti, "position.x", &pos_x);
    get_float64(msg_pointer, parse_pose_.ti, "position.y", &pos_y);
    get_float64(msg_pointer, parse_pose_.ti, "position.z", &pos_z);
    get_float64(msg_pointer, parse_pose_.ti, "orientation.x", &orient_x);
    get_float64(msg_pointer, parse_pose_.ti, "orientation.y", &orient_y);
    get_float64(msg_pointer, parse_pose_.ti, "orientation.z", &orient_z);
    get_float64(msg_pointer, parse_pose_.ti, "orientation.w", &orient_w);
    // Send to robot
    sendPoseCmd(&commData, pos_x, pos_y, pos_z, orient_x, orient_y, orient_z, orient_w);
}
/* End of Figure 14. */

/* Figure 15. */
typedef struct
{
    CFE_MSG_TelemetryHeader_t TlmHeader;
    uint8_t data[260];
} JointStateData_t;
/* End of Figure 15. */

static JointStateData_t tlm_joint_state;

/* Figure 16. */
int32 EdorasAppReportHousekeeping(const CFE_MSG_CommandHeader_t *Msg)
{
    //>>> snip, snip, snip

    // If data received from robot update telemetry data to send back to ground
    uint8_t* js_msg = create_msg(parse_joint_state_.ti);

    // Fill data
    resize_sequence(js_msg, parse_joint_state_.ti, "position", 7);

    set_float64(js_msg, parse_joint_state_.ti, "position.0", joints[0]);
    set_float64(js_msg, parse_joint_state_.ti, "position.1", joints[1]);
    set_float64(js_msg, parse_joint_state_.ti, "position.2", joints[2]);
    /* >>> snip, snip, snip: filled in */
    set_float64(js_msg, parse_joint_state_.ti, "position.3", joints[3]);
    set_float64(js_msg, parse_joint_state_.ti, "position.4", joints[4]);
    set_float64(js_msg, parse_joint_state_.ti, "position.5", joints[5]);
    set_float64(js_msg, parse_joint_state_.ti, "position.6", joints[6]);

    resize_sequence(js_msg, parse_joint_state_.ti, "name", 7);

    //>>> snip, snip, snip
    /* filled in */
    set_const_char(js_msg, parse_joint_state_.ti, "name.0", "big_arm_joint_2");
    set_const_char(js_msg, parse_joint_state_.ti, "name.1", "big_arm_joint_3");
    set_const_char(js_msg, parse_joint_state_.ti, "name.2", "big_arm_joint_4");
    set_const_char(js_msg, parse_joint_state_.ti, "name.3", "big_arm_joint_5");
    /* end */
    set_const_char(js_msg, parse_joint_state_.ti, "name.4", "big_arm_joint_6");
    set_const_char(js_msg, parse_joint_state_.ti, "name.5", "big_arm_joint_7");
    set_const_char(js_msg, parse_joint_state_.ti, "name.6", "big_arm_joint_8");

    set_int32(js_msg, parse_joint_state_.ti, "header.stamp.sec", sec);
    set_uint32(js_msg, parse_joint_state_.ti, "header.stamp.nanosec", nanosec);

    /* filled in, as the app has it */
    debug_parse_buffer(js_msg, parse_joint_state_.ti);
    /* end */

    // Convert data to serialized version
    uint8_t* tlm_data = NULL;
    size_t tlm_data_size;
    tlm_data = from_msg_pointer_to_uint_buffer(js_msg, parse_joint_state_.ts,
        parse_joint_state_.ti, &tlm_data_size);

    // Fill telemetry message
    for(size_t i = 0; i < tlm_data_size; i++)
        memcpy(&tlm_joint_state.data[i], (uint8_t*)(tlm_data) + i, sizeof(uint8_t));

    CFE_SB_TimeStampMsg(&tlm_joint_state.TlmHeader.Msg);
    CFE_SB_TransmitMsg(&tlm_joint_state.TlmHeader.Msg, true);

    // >> snip, snip, snip
    /* filled in */
    free(js_msg);
    free(tlm_data);
    /* end */
    return CFE_SUCCESS;
}
/* End of Figure 16. */

static void initializeParseData(const char *_interface_name, const char *_interface_type, ParseData_t *_parse_data)
{
    _parse_data->ti = get_type_info(_interface_name, _interface_type);
    _parse_data->ts_library = get_type_support_library(_interface_name, _interface_type);
    _parse_data->ts = get_type_support(_interface_name, _interface_type, _parse_data->ts_library);
}

void AppInit(void)
{
    initializeParseData("geometry_msgs", "Pose", &parse_pose_);
    initializeParseData("sensor_msgs", "JointState", &parse_joint_state_);
    CFE_MSG_Init(
        &tlm_joint_state.TlmHeader.Msg, CFE_SB_ValueToMsgId(EDORAS_APP_TLM_MID), sizeof(tlm_joint_state));
}

void AppCommand(CFE_SB_Buffer_t *SBBufPtr)
{
    EdorasAppProcessGroundCommand(SBBufPtr);
}

void AppHousekeeping(void)
{
    (void)EdorasAppReportHousekeeping(NULL);
}

const void *AppOutput(size_t *size)
{
    *size = sizeof(commanded);
    return commanded;
}
