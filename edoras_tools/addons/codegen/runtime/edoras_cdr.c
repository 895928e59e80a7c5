#include "edoras_core/cdr.h"

#include <string.h>

/** Most bytes that may follow the last field: writers round a message up to 4. */

/* What the code takes for granted; an array of -1 elements stops the compiler where it does not hold. */
typedef char a_byte_has_8_bits[(UINT8_MAX == 255U) ? 1 : -1];
typedef char a_float_has_4_bytes[(sizeof(float) == 4U) ? 1 : -1];
typedef char a_double_has_8_bytes[(sizeof(double) == 8U) ? 1 : -1];
typedef char a_bool_has_1_byte[(sizeof(bool) == 1U) ? 1 : -1];
typedef char a_size_has_4_bytes_or_more[(sizeof(size_t) >= 4U) ? 1 : -1];

const char *edoras_status_text(edoras_status_t status)
{
    static const char *const texts[] = {
        "ok",
        "a pointer is NULL, an object too small, or the type not in this library",
        "the representation is not CDR",
        "a field lies outside the given bytes",
        "more than padding follows the last field",
        "a string does not end in NUL",
        "a sequence or string is longer than its bound",
        "the message does not fit the buffer",
    };
    const size_t index = (size_t)status;

    return (index < EDORAS_CAPACITY(texts)) ? texts[index] : "unknown status";
}

/** Bytes to the next multiple of an alignment, which is a power of 2. */
static size_t padding_at(size_t position, size_t alignment)
{
    return (alignment - (position & (alignment - 1U))) & (alignment - 1U);
}

/** Tell how this processor stores numbers; compilers know the answer. */
static bool is_big_endian(void)
{
    const uint16_t number = 1U;
    uint8_t first;

    (void)memcpy(&first, &number, sizeof(first));
    return first == 0U;
}

/** Copy so many numbers of so many bytes each, in the same byte order or in the other. */
static void copy_many(void *to, const void *from, size_t count, size_t width, bool same_order)
{
    if (same_order) {
        (void)memcpy(to, from, count * width);
    } else {
        uint8_t *const target = to;
        const uint8_t *const source = from;
        size_t i;

        for (i = 0U; i < (count * width); ++i) {
            target[i] = source[i ^ (width - 1U)]; /* widths are powers of 2: this mirrors each number */
        }
    }
}

/* Reading. */

void edoras_reader_open(edoras_reader_t *reader, const uint8_t *cdr, size_t size)
{
    (void)memset(reader, 0, sizeof(*reader));
    if (cdr == NULL) {
        reader->status = EDORAS_ARGUMENT;
    } else if (size < EDORAS_ENCAPSULATION_SIZE) {
        reader->status = EDORAS_TRUNCATED;
    } else if ((cdr[0] != 0U) || (cdr[1] > 1U)) {
        reader->status = EDORAS_ENCAPSULATION;
    } else {
        reader->body = &cdr[EDORAS_ENCAPSULATION_SIZE];
        reader->size = size - EDORAS_ENCAPSULATION_SIZE;
        reader->big_endian = (cdr[1] == 0U);
    }
}

edoras_status_t edoras_reader_close(const edoras_reader_t *reader, size_t most_trailing)
{
    edoras_status_t status = reader->status;

    if ((status == EDORAS_OK) && ((reader->size - reader->position) > most_trailing)) {
        status = EDORAS_TRAILING;
    }
    return status;
}

/** Return the next bytes, from an alignment on, and pass over them; NULL where they are not all there. */
static const uint8_t *take(edoras_reader_t *reader, size_t alignment, size_t size)
{
    const uint8_t *bytes = NULL;

    if (reader->status == EDORAS_OK) {
        const size_t padding = padding_at(reader->position, alignment);
        const size_t left = reader->size - reader->position;

        if ((padding > left) || (size > (left - padding))) {
            reader->status = EDORAS_TRUNCATED;
        } else {
            bytes = &reader->body[reader->position + padding];
            reader->position += padding + size;
        }
    }
    return bytes;
}

static uint16_t load16(const uint8_t *bytes, bool big_endian)
{
    const uint32_t first = bytes[0];
    const uint32_t last = bytes[1];

    return (uint16_t)(big_endian ? ((first << 8U) | last) : ((last << 8U) | first));
}

static uint32_t load32(const uint8_t *bytes, bool big_endian)
{
    const uint32_t first = load16(&bytes[0], big_endian);
    const uint32_t last = load16(&bytes[2], big_endian);

    return big_endian ? ((first << 16U) | last) : ((last << 16U) | first);
}

static uint64_t load64(const uint8_t *bytes, bool big_endian)
{
    const uint64_t first = load32(&bytes[0], big_endian);
    const uint64_t last = load32(&bytes[4], big_endian);

    return big_endian ? ((first << 32U) | last) : ((last << 32U) | first);
}

uint8_t edoras_read_uint8(edoras_reader_t *reader)
{
    const uint8_t *const bytes = take(reader, 1U, 1U);

    return (bytes == NULL) ? 0U : bytes[0];
}

uint16_t edoras_read_uint16(edoras_reader_t *reader)
{
    const uint8_t *const bytes = take(reader, 2U, 2U);

    return (bytes == NULL) ? 0U : load16(bytes, reader->big_endian);
}

uint32_t edoras_read_uint32(edoras_reader_t *reader)
{
    const uint8_t *const bytes = take(reader, 4U, 4U);

    return (bytes == NULL) ? 0U : load32(bytes, reader->big_endian);
}

uint64_t edoras_read_uint64(edoras_reader_t *reader)
{
    const uint8_t *const bytes = take(reader, 8U, 8U);

    return (bytes == NULL) ? 0U : load64(bytes, reader->big_endian);
}

bool edoras_read_bool(edoras_reader_t *reader)
{
    return edoras_read_uint8(reader) != 0U;
}

/* Signed values are the same bits, copied: what a cast from above their range does is left to compilers. */

int8_t edoras_read_int8(edoras_reader_t *reader)
{
    const uint8_t bits = edoras_read_uint8(reader);
    int8_t value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

int16_t edoras_read_int16(edoras_reader_t *reader)
{
    const uint16_t bits = edoras_read_uint16(reader);
    int16_t value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

int32_t edoras_read_int32(edoras_reader_t *reader)
{
    const uint32_t bits = edoras_read_uint32(reader);
    int32_t value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

int64_t edoras_read_int64(edoras_reader_t *reader)
{
    const uint64_t bits = edoras_read_uint64(reader);
    int64_t value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

float edoras_read_float32(edoras_reader_t *reader)
{
    const uint32_t bits = edoras_read_uint32(reader);
    float value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

double edoras_read_float64(edoras_reader_t *reader)
{
    const uint64_t bits = edoras_read_uint64(reader);
    double value;

    (void)memcpy(&value, &bits, sizeof(value));
    return value;
}

void edoras_read_many(edoras_reader_t *reader, void *data, size_t count, size_t width)
{
    if (count > 0U) {
        const uint8_t *const bytes = take(reader, width, count * width);

        if (bytes == NULL) {
            (void)memset(data, 0, count * width);
        } else {
            copy_many(data, bytes, count, width, reader->big_endian == is_big_endian());
        }
    }
}

uint32_t edoras_read_count(edoras_reader_t *reader, size_t capacity)
{
    uint32_t count = edoras_read_uint32(reader);

    if (count > capacity) {
        reader->status = EDORAS_BOUND;
        count = 0U;
    }
    return count;
}

uint32_t edoras_read_string(edoras_reader_t *reader, char *data, size_t capacity)
{
    uint32_t length = edoras_read_uint32(reader); /* with the NUL; some writers send an empty one as 0 */

    if (length > 0U) {
        const uint8_t *const bytes = take(reader, 1U, length);

        --length;
        if (bytes == NULL) {
            length = 0U;
        } else if (bytes[length] != 0U) {
            reader->status = EDORAS_UNTERMINATED;
            length = 0U;
        } else if (length >= capacity) {
            reader->status = EDORAS_BOUND;
            length = 0U;
        } else {
            (void)memcpy(data, bytes, length);
        }
    }
    data[length] = '\0';
    return length;
}

uint32_t edoras_read_wstring(edoras_reader_t *reader, uint16_t *data, size_t capacity)
{
    const uint32_t length = edoras_read_count(reader, capacity - 1U);
    uint32_t i;

    for (i = 0U; i < length; ++i) {
        data[i] = (uint16_t)(edoras_read_uint32(reader) & 0xFFFFU);
    }
    data[length] = 0U;
    return length;
}

/* Writing. */

void edoras_writer_open(edoras_writer_t *writer, uint8_t *buffer, size_t size)
{
    (void)memset(writer, 0, sizeof(*writer));
    if (buffer == NULL) {
        writer->status = EDORAS_ARGUMENT;
    } else if (size < EDORAS_ENCAPSULATION_SIZE) {
        writer->status = EDORAS_NO_SPACE;
    } else {
        (void)memset(buffer, 0, EDORAS_ENCAPSULATION_SIZE);
        buffer[1] = 1U;
        writer->body = &buffer[EDORAS_ENCAPSULATION_SIZE];
        writer->size = size - EDORAS_ENCAPSULATION_SIZE;
    }
}

edoras_status_t edoras_writer_close(const edoras_writer_t *writer, size_t *length)
{
    if (length != NULL) {
        *length = (writer->status == EDORAS_OK) ? (writer->position + EDORAS_ENCAPSULATION_SIZE) : 0U;
    }
    return writer->status;
}

/** Return where the next bytes go, with padding in front of them; NULL where there is no space. */
static uint8_t *give(edoras_writer_t *writer, size_t alignment, size_t size)
{
    uint8_t *bytes = NULL;

    if (writer->status == EDORAS_OK) {
        const size_t padding = padding_at(writer->position, alignment);
        const size_t left = writer->size - writer->position;

        if ((padding > left) || (size > (left - padding))) {
            writer->status = EDORAS_NO_SPACE;
        } else {
            (void)memset(&writer->body[writer->position], 0, padding);
            bytes = &writer->body[writer->position + padding];
            writer->position += padding + size;
        }
    }
    return bytes;
}

static void store16(uint8_t *bytes, uint32_t value)
{
    bytes[0] = (uint8_t)(value & 0xFFU);
    bytes[1] = (uint8_t)((value >> 8U) & 0xFFU);
}

static void store32(uint8_t *bytes, uint32_t value)
{
    store16(&bytes[0], value);
    store16(&bytes[2], value >> 16U);
}

void edoras_write_uint8(edoras_writer_t *writer, uint8_t value)
{
    uint8_t *const bytes = give(writer, 1U, 1U);

    if (bytes != NULL) {
        bytes[0] = value;
    }
}

void edoras_write_uint16(edoras_writer_t *writer, uint16_t value)
{
    uint8_t *const bytes = give(writer, 2U, 2U);

    if (bytes != NULL) {
        store16(bytes, value);
    }
}

void edoras_write_uint32(edoras_writer_t *writer, uint32_t value)
{
    uint8_t *const bytes = give(writer, 4U, 4U);

    if (bytes != NULL) {
        store32(bytes, value);
    }
}

void edoras_write_uint64(edoras_writer_t *writer, uint64_t value)
{
    uint8_t *const bytes = give(writer, 8U, 8U);

    if (bytes != NULL) {
        store32(&bytes[0], (uint32_t)(value & 0xFFFFFFFFU));
        store32(&bytes[4], (uint32_t)(value >> 32U));
    }
}

void edoras_write_bool(edoras_writer_t *writer, bool value)
{
    edoras_write_uint8(writer, value ? 1U : 0U);
}

void edoras_write_int8(edoras_writer_t *writer, int8_t value)
{
    edoras_write_uint8(writer, (uint8_t)value);
}

void edoras_write_int16(edoras_writer_t *writer, int16_t value)
{
    edoras_write_uint16(writer, (uint16_t)value);
}

void edoras_write_int32(edoras_writer_t *writer, int32_t value)
{
    edoras_write_uint32(writer, (uint32_t)value);
}

void edoras_write_int64(edoras_writer_t *writer, int64_t value)
{
    edoras_write_uint64(writer, (uint64_t)value);
}

void edoras_write_float32(edoras_writer_t *writer, float value)
{
    uint32_t bits;

    (void)memcpy(&bits, &value, sizeof(bits));
    edoras_write_uint32(writer, bits);
}

void edoras_write_float64(edoras_writer_t *writer, double value)
{
    uint64_t bits;

    (void)memcpy(&bits, &value, sizeof(bits));
    edoras_write_uint64(writer, bits);
}

void edoras_write_many(edoras_writer_t *writer, const void *data, size_t count, size_t width)
{
    uint8_t *const bytes = (count > 0U) ? give(writer, width, count * width) : NULL;

    if (bytes != NULL) {
        copy_many(bytes, data, count, width, !is_big_endian());
    }
}

uint32_t edoras_write_count(edoras_writer_t *writer, uint32_t count, size_t capacity)
{
    uint32_t written = 0U;

    if (count <= capacity) {
        edoras_write_uint32(writer, count);
        written = count;
    } else if (writer->status == EDORAS_OK) {
        writer->status = EDORAS_BOUND;
    } else {
        /* The first mistake is the one to report. */
    }
    return written;
}

void edoras_write_string(edoras_writer_t *writer, const char *data, uint32_t size, size_t capacity)
{
    if (size < capacity) {
        edoras_write_uint32(writer, size + 1U);
        edoras_write_many(writer, data, size, 1U);
        edoras_write_uint8(writer, 0U);
    } else if (writer->status == EDORAS_OK) {
        writer->status = EDORAS_BOUND;
    } else {
        /* The first mistake is the one to report. */
    }
}

void edoras_write_wstring(edoras_writer_t *writer, const uint16_t *data, uint32_t size, size_t capacity)
{
    const uint32_t count = edoras_write_count(writer, size, capacity - 1U);
    uint32_t i;

    for (i = 0U; i < count; ++i) {
        edoras_write_uint32(writer, data[i]);
    }
}

bool edoras_set_string(char *data, size_t capacity, uint32_t *size, const char *text)
{
    size_t length = 0U;
    bool fits = (text != NULL);

    while (fits && (text[length] != '\0')) {
        ++length;
        fits = (length < capacity);
    }
    if (fits) {
        (void)memcpy(data, text, length);
        data[length] = '\0';
        *size = (uint32_t)length;
    }
    return fits;
}
