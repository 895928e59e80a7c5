/**
 * The functions of edoras_core, over the messages of this library: apps that were written for the one compile
 * and link with the other. Nothing here takes memory from a heap.
 *
 * Where edoras_core takes memory, a pool gives: EDORAS_POOL messages and as many buffers for each type that
 * the library was made for, handed out in turn. What create_msg and from_uint_buffer_to_msg_pointer return is
 * good until the EDORAS_POOL-th such call after, for the same type; likewise what
 * from_msg_pointer_to_uint_buffer returns. Nothing has to be given back, and nothing runs out. Types that are
 * only there because others nest them have no pool: NULL. (Apps that call free(): see the end of this file.)
 *
 * The pools and their turns are the only state. Tasks that share a library must not take from the pool of one
 * type at the same time; functions that end in _into, and those of the messages themselves, keep no state.
 *
 * Names are dotted, with indexes: "position.x", "header.stamp.sec", "position.0", "poses.3.pose.position.x".
 * A function that returns bool says false where there is no such field, element, kind, or the message is NULL
 * because its bytes could not be parsed. set_ then changes nothing. get_ then writes 0, or an empty string: the
 * app's variable is never left without a value. (Generated with --keep-values it is left as it was.)
 */
#ifndef EDORAS_CORE_INTERFACE_H
#define EDORAS_CORE_INTERFACE_H

#include "edoras_core/types.h"

#ifdef __cplusplus
#include <cstdlib>
#endif
#include <stdio.h>  /* apps get it from edoras_core's header, which includes it */
#include <stdlib.h> /* likewise; and it declares free() before the macro at the end */

/** Size of the arrays that get_const_char and get_const_char16 fill, their end included. */
#define EDORAS_CONST_CHAR_MAX_SIZE 100

#ifdef __cplusplus
extern "C" {
#endif

/* Types. The first argument is the package, as "geometry_msgs", the second the name, as "Pose". */

/** There is nothing to load; NULL where the library has no such type. */
void *get_type_support_library(const char *interface_name, const char *interface_type);

const TypeInfo_t *get_type_info(const char *interface_name, const char *interface_type);

const TypeSupport_t *get_type_support(const char *interface_name, const char *interface_type,
                                      void *ts_library);

/* Whole messages. */

/** A message with the default values of its definition, from the pool. */
uint8_t *create_msg(const TypeInfo_t *ti);

/** The same where the caller keeps the message. EDORAS_ARGUMENT where it is smaller than size_of_. */
edoras_status_t create_msg_into(const TypeInfo_t *ti, void *message, size_t size);

/**
 * Read the EDORAS envelope and the CDR that lie at an offset of a packet, into a message of the pool.
 *
 * With an offset of 8 or more a space packet's header is in front, and nothing past the packet's end, as its
 * length field has it, is read. With a smaller offset, nothing past buffer_size of the type's TypeInfo_t.
 *
 * @param buffer_size receives the size of the message's struct.
 * @return NULL where the bytes are no such message, or one that is longer than the library's bounds.
 */
uint8_t *from_uint_buffer_to_msg_pointer(const uint8_t *buffer, size_t offset, const TypeSupport_t *ts,
                                         const TypeInfo_t *ti, size_t *buffer_size);

/** The same from a buffer of a given size into a message of the caller, and with the reason when it fails. */
edoras_status_t from_uint_buffer_to_msg_pointer_into(const uint8_t *buffer, size_t size, size_t offset,
                                                     const TypeSupport_t *ts, const TypeInfo_t *ti,
                                                     void *message, size_t message_size);

/**
 * Write the EDORAS envelope and the CDR of a message.
 *
 * @param buffer_size receives the bytes of both, at most buffer_size of the type's TypeInfo_t; 0 on failure.
 * @return a buffer of the pool; NULL where a sequence or string claims more elements than it can hold.
 */
uint8_t *from_msg_pointer_to_uint_buffer(uint8_t *message, const TypeSupport_t *ts, const TypeInfo_t *ti,
                                         size_t *buffer_size);

/** The same into a buffer of the caller, and with the reason when it fails. */
edoras_status_t from_msg_pointer_to_uint_buffer_into(const uint8_t *message, const TypeSupport_t *ts,
                                                     const TypeInfo_t *ti, uint8_t *buffer, size_t size,
                                                     size_t *buffer_size);

/* Sequences. */

/** Elements that are new have their default values, the others stay. False where size is above the bound. */
bool resize_sequence(uint8_t *message, const TypeInfo_t *ti, const char *name, size_t size);

/** Elements of a sequence or array. */
bool get_sequence_size(const uint8_t *message, const TypeInfo_t *ti, const char *name, size_t *size);

/* Values. */

bool get_bool(const uint8_t *message, const TypeInfo_t *ti, const char *name, bool *value);
bool get_byte(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value);
bool get_char(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value);
bool get_uint8(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value);
bool get_int8(const uint8_t *message, const TypeInfo_t *ti, const char *name, int8_t *value);
bool get_uint16(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint16_t *value);
bool get_int16(const uint8_t *message, const TypeInfo_t *ti, const char *name, int16_t *value);
bool get_uint32(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint32_t *value);
bool get_int32(const uint8_t *message, const TypeInfo_t *ti, const char *name, int32_t *value);
bool get_uint64(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint64_t *value);
bool get_int64(const uint8_t *message, const TypeInfo_t *ti, const char *name, int64_t *value);
bool get_float32(const uint8_t *message, const TypeInfo_t *ti, const char *name, float *value);
bool get_float64(const uint8_t *message, const TypeInfo_t *ti, const char *name, double *value);

/** False, too, where the string does not fit; then all of the array is 0. */
bool get_const_char(const uint8_t *message, const TypeInfo_t *ti, const char *name,
                    char value[EDORAS_CONST_CHAR_MAX_SIZE]);

/** A string of any length; false where it and its NUL do not fit the size. */
bool get_const_char_into(const uint8_t *message, const TypeInfo_t *ti, const char *name, char *value,
                         size_t size);

/** A wide string, as UTF-16 units with a 0 at the end. */
bool get_const_char16(const uint8_t *message, const TypeInfo_t *ti, const char *name,
                      uint16_t value[EDORAS_CONST_CHAR_MAX_SIZE]);

bool set_bool(uint8_t *message, const TypeInfo_t *ti, const char *name, bool value);
bool set_byte(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value);
bool set_char(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value);
bool set_uint8(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value);
bool set_int8(uint8_t *message, const TypeInfo_t *ti, const char *name, int8_t value);
bool set_uint16(uint8_t *message, const TypeInfo_t *ti, const char *name, uint16_t value);
bool set_int16(uint8_t *message, const TypeInfo_t *ti, const char *name, int16_t value);
bool set_uint32(uint8_t *message, const TypeInfo_t *ti, const char *name, uint32_t value);
bool set_int32(uint8_t *message, const TypeInfo_t *ti, const char *name, int32_t value);
bool set_uint64(uint8_t *message, const TypeInfo_t *ti, const char *name, uint64_t value);
bool set_int64(uint8_t *message, const TypeInfo_t *ti, const char *name, int64_t value);
bool set_float32(uint8_t *message, const TypeInfo_t *ti, const char *name, float value);
bool set_float64(uint8_t *message, const TypeInfo_t *ti, const char *name, double value);

/** False, too, where the text is longer than the string's bound. */
bool set_const_char(uint8_t *message, const TypeInfo_t *ti, const char *name, const char *value);

/** A wide string, as UTF-16 units with a 0 at the end. */
bool set_const_char16(uint8_t *message, const TypeInfo_t *ti, const char *name, const uint16_t *value);

/* What else edoras_core has. */

/** Prints nothing: a task of flight software has no time for it, and often no console. */
void debug_parse_buffer(uint8_t *message, const TypeInfo_t *ti);

/** Prints nothing. */
void printBuffer(uint8_t *data, size_t data_size, const char *text);

/** NULL for memory of a pool; any other pointer as it is. */
void *edoras_heap_only(void *pointer);

#ifdef __cplusplus
}
#endif

/*
 * Apps written for edoras_core give its memory back with free(), which would end the process if it were given
 * memory of a pool. Behind this header it is given NULL instead, and what came from a heap as before. A file
 * that does not include this header must not free what the functions above return.
 */
#ifndef EDORAS_KEEP_FREE
#define free(pointer) free(edoras_heap_only(pointer))
#endif

#endif
