/**
 * The words that the table of names is written in.
 *
 * One row tells of a field where it is, where its first element, how large one is, and how many there are.
 */
#ifndef EDORAS_CORE_TABLES_H
#define EDORAS_CORE_TABLES_H

#include "edoras_core/types.h"

#define EDORAS_MEMBER(type, field) (((const type *)0)->field)

#define EDORAS_ONE(type, field) offsetof(type, field), 0U, sizeof(EDORAS_MEMBER(type, field)), 0U

#define EDORAS_ARRAY(type, field)                                                                            \
    offsetof(type, field), 0U, sizeof(EDORAS_MEMBER(type, field)[0]),                                        \
        (uint32_t)EDORAS_CAPACITY(EDORAS_MEMBER(type, field))

#define EDORAS_SEQUENCE(type, field)                                                                         \
    offsetof(type, field), offsetof(type, field.data) - offsetof(type, field),                               \
        sizeof(EDORAS_MEMBER(type, field).data[0]), (uint32_t)EDORAS_CAPACITY(EDORAS_MEMBER(type, field).data)

/** The functions of a message type, taking any pointer, as the table holds them. */
#define EDORAS_FUNCTIONS(type)                                                                               \
    static void type##__init_any(void *message)                                                              \
    {                                                                                                        \
        type##__init((type *)message);                                                                       \
    }                                                                                                        \
    static edoras_status_t type##__encode_any(                                                               \
        const void *message, uint8_t *buffer, size_t size, size_t *length)                                   \
    {                                                                                                        \
        return type##__encode((const type *)message, buffer, size, length);                                  \
    }                                                                                                        \
    static edoras_status_t type##__decode_any(void *message, const uint8_t *cdr, size_t length)              \
    {                                                                                                        \
        return type##__decode((type *)message, cdr, length);                                                 \
    }

/** Bytes of the longest message, EDORAS envelope included. */
#define EDORAS_BUFFER_SIZE(type) ((2U * (size_t)EDORAS_ENVELOPE_WORD) + type##__MAX_CDR)

/** The messages and buffers that are handed out of a type. */
#define EDORAS_MAKE_POOL(type)                                                                               \
    static type type##__messages[EDORAS_POOL];                                                               \
    static uint8_t type##__buffers[EDORAS_POOL][EDORAS_BUFFER_SIZE(type)];                                   \
    static edoras_pool_t type##__pool = {(uint8_t *)type##__messages, &type##__buffers[0][0], 0U, 0U};

#endif
