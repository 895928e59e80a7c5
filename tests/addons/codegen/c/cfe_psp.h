/** As much of the platform support and of OSAL as the generator uses. */
#ifndef CFE_PSP_H
#define CFE_PSP_H

#include "cfe.h"

typedef struct {
    int64 ticks; /* of 100 ns */
} OS_time_t;

static inline int64 OS_TimeGetTotalMicroseconds(OS_time_t tm)
{
    return tm.ticks / 10;
}

void CFE_PSP_GetTime(OS_time_t *LocalTime);

#endif
