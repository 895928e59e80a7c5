/* A flight application's packets, as its own headers declare them. */
#include <stdbool.h>
#include <stdint.h>

typedef struct { uint8_t Primary[6], Secondary[6], Spare[4]; } CFE_MSG_TelemetryHeader_t;
typedef struct { uint8_t Primary[6], Secondary[2]; } CFE_MSG_CommandHeader_t;

typedef enum { ROVER_IDLE, ROVER_DRIVING, ROVER_LOST = -1 } ROVER_Mode_t;
typedef struct { float X, Y; double Heading; } ROVER_Pose_t;

typedef struct
{
    uint8_t      CommandCounter, CommandErrorCounter;
    uint16_t     Battery : 10, Charging : 1, Sensors : 5;
    ROVER_Mode_t Mode;
    char         Driver[20];
    ROVER_Pose_t Path[4];
    union { uint32_t Word; float Volts; } Supply;
} ROVER_HkTlm_Payload_t;

typedef struct
{
    CFE_MSG_TelemetryHeader_t TelemetryHeader;
    ROVER_HkTlm_Payload_t     Payload;
} ROVER_HkTlm_t;

typedef struct
{
    CFE_MSG_CommandHeader_t CommandHeader;
    float                   Speed;
    bool                    Reverse;
} ROVER_DriveCmd_t;
