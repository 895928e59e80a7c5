/**
 * What the flight apps of the tests have in common. Each is in the style of a public one: it does not look at what the
 * functions of edoras_core return, and frees what they give.
 */
#ifndef APP_H
#define APP_H

#include "cfe.h"

void AppInit(void);
void AppCommand(CFE_SB_Buffer_t *SBBufPtr);
void AppHousekeeping(void);

/** What the last command made the app give away: to the robot, or to the other side. */
const void *AppOutput(size_t *size);

#endif
