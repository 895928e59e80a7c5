/**
 * CDR (OMG formal/02-06-51, 15.3; version 1 of DDS-XTypes 7.4): primitives to bytes and back, without heap,
 * recursion or global state, and with no regard to the byte order or word size of this processor.
 *
 * A reader or writer stops at its first mistake and remembers it: what follows reads zeros, or writes
 * nothing, and the end returns the mistake's status. No byte outside the given buffer is touched.
 */
#ifndef EDORAS_CORE_CDR_H
#define EDORAS_CORE_CDR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "edoras_core/config.h"

#ifdef __cplusplus
extern "C" {
#endif

/** Bytes in front of every body: representation and options (DDSI-RTPS 10.2). */
#define EDORAS_ENCAPSULATION_SIZE 4U

/** Elements of an array. */
#define EDORAS_CAPACITY(array) (sizeof(array) / sizeof((array)[0]))

/** Give a string of a message a text; false, and nothing changed, where it is longer than its bound. */
#define EDORAS_SET_STRING(string, text) \
    edoras_set_string((string).data, sizeof((string).data), &(string).size, (text))

typedef enum {
    EDORAS_OK = 0,
    EDORAS_ARGUMENT,      /**< a pointer is NULL, an object too small, or a type not in this library */
    EDORAS_ENCAPSULATION, /**< neither CDR little-endian (00 01) nor CDR big-endian (00 00) */
    EDORAS_TRUNCATED,     /**< decode: a field lies outside the given bytes */
    EDORAS_TRAILING,      /**< decode: more bytes follow the last field than ROS 2 leaves there */
    EDORAS_UNTERMINATED,  /**< decode: a string does not end in NUL */
    EDORAS_BOUND,         /**< a sequence or string is longer than the bound it was generated with */
    EDORAS_NO_SPACE       /**< encode: the message does not fit the given buffer */
} edoras_status_t;

/** What went wrong, in a few words. */
const char *edoras_status_text(edoras_status_t status);

/** Where a decode is. */
typedef struct {
    const uint8_t *body; /**< the byte after the encapsulation: alignment counts from here */
    size_t size;         /**< bytes of the body */
    size_t position;     /**< bytes of it that are read */
    bool big_endian;
    edoras_status_t status;
} edoras_reader_t;

/** Where an encode is; it writes little-endian. */
typedef struct {
    uint8_t *body;
    size_t size;
    size_t position;
    edoras_status_t status;
} edoras_writer_t;

void edoras_reader_open(edoras_reader_t *reader, const uint8_t *cdr, size_t size);

/** End a decode; the most bytes that may follow the last field are given. */
edoras_status_t edoras_reader_close(const edoras_reader_t *reader, size_t most_trailing);

bool edoras_read_bool(edoras_reader_t *reader);
uint8_t edoras_read_uint8(edoras_reader_t *reader);
int8_t edoras_read_int8(edoras_reader_t *reader);
uint16_t edoras_read_uint16(edoras_reader_t *reader);
int16_t edoras_read_int16(edoras_reader_t *reader);
uint32_t edoras_read_uint32(edoras_reader_t *reader);
int32_t edoras_read_int32(edoras_reader_t *reader);
uint64_t edoras_read_uint64(edoras_reader_t *reader);
int64_t edoras_read_int64(edoras_reader_t *reader);
float edoras_read_float32(edoras_reader_t *reader);
double edoras_read_float64(edoras_reader_t *reader);

/** Read so many integers or floats of so many bytes each; none takes no padding. */
void edoras_read_many(edoras_reader_t *reader, void *data, size_t count, size_t width);

/** Read the number of elements of a sequence; 0 and EDORAS_BOUND above the capacity. */
uint32_t edoras_read_count(edoras_reader_t *reader, size_t capacity);

/** Read a string of at most capacity - 1 bytes and end it with NUL; return its length. */
uint32_t edoras_read_string(edoras_reader_t *reader, char *data, size_t capacity);

/** Read a wide string of at most capacity - 1 UTF-16 units and end it with 0; return its length. */
uint32_t edoras_read_wstring(edoras_reader_t *reader, uint16_t *data, size_t capacity);

void edoras_writer_open(edoras_writer_t *writer, uint8_t *buffer, size_t size);

/** End an encode; the length counts the encapsulation, and is 0 where the message was not written. */
edoras_status_t edoras_writer_close(const edoras_writer_t *writer, size_t *length);

void edoras_write_bool(edoras_writer_t *writer, bool value);
void edoras_write_uint8(edoras_writer_t *writer, uint8_t value);
void edoras_write_int8(edoras_writer_t *writer, int8_t value);
void edoras_write_uint16(edoras_writer_t *writer, uint16_t value);
void edoras_write_int16(edoras_writer_t *writer, int16_t value);
void edoras_write_uint32(edoras_writer_t *writer, uint32_t value);
void edoras_write_int32(edoras_writer_t *writer, int32_t value);
void edoras_write_uint64(edoras_writer_t *writer, uint64_t value);
void edoras_write_int64(edoras_writer_t *writer, int64_t value);
void edoras_write_float32(edoras_writer_t *writer, float value);
void edoras_write_float64(edoras_writer_t *writer, double value);

/** Write so many integers or floats of so many bytes each; none takes no padding. */
void edoras_write_many(edoras_writer_t *writer, const void *data, size_t count, size_t width);

/** Write the number of elements of a sequence and return it; 0 and EDORAS_BOUND above the capacity. */
uint32_t edoras_write_count(edoras_writer_t *writer, uint32_t count, size_t capacity);

/** Write a string of some bytes, which may hold at most capacity - 1, and its NUL. */
void edoras_write_string(edoras_writer_t *writer, const char *data, uint32_t size, size_t capacity);

/** Write a wide string of some UTF-16 units, which may hold at most capacity - 1. */
void edoras_write_wstring(edoras_writer_t *writer, const uint16_t *data, uint32_t size, size_t capacity);

/** Behind EDORAS_SET_STRING. */
bool edoras_set_string(char *data, size_t capacity, uint32_t *size, const char *text);

#ifdef __cplusplus
}
#endif

#endif
