#include "edoras_core/interface.h"

#include <string.h>

/** Where the elements of a string start, from its count. */
#define STRING_DATA sizeof(uint32_t)
/** Bytes of the two lengths in front of a CDR. */
#define ENVELOPE_SIZE (2U * (size_t)EDORAS_ENVELOPE_WORD)
/** The space packet's primary header and the shortest header of cFE behind it (CCSDS 133.0-B, 4.1.3). */
#define PRIMARY_HEADER_SIZE 6U
#define SHORTEST_HEADER_SIZE 8U

/** What a name refers to: a field of a message, or one element of it. */
typedef struct {
    const MemberInfo_t *member;
    size_t offset; /* from the start of the outermost message */
    bool whole;    /* a sequence or array itself */
} place_t;

/* Types. */

/** Compare two names that end in NUL: below 0, 0 or above, as strcmp. */
static int compare_types(const TypeInfo_t *type, const char *package, const char *name)
{
    const int first = strcmp(type->message_namespace_, package);

    return (first != 0) ? first : strcmp(type->message_name_, name);
}

const TypeSupport_t *get_type_support(const char *interface_name, const char *interface_type,
                                      void *ts_library)
{
    const TypeSupport_t *found = NULL;
    size_t low = 0U;
    size_t high = ((interface_name == NULL) || (interface_type == NULL)) ? 0U : edoras_types_count;

    (void)ts_library;
    while ((found == NULL) && (low < high)) {
        const size_t middle = low + ((high - low) / 2U);
        const int order = compare_types(edoras_types[middle].data, interface_name, interface_type);

        if (order < 0) {
            low = middle + 1U;
        } else if (order > 0) {
            high = middle;
        } else {
            found = &edoras_types[middle];
        }
    }
    return found;
}

const TypeInfo_t *get_type_info(const char *interface_name, const char *interface_type)
{
    const TypeSupport_t *const found = get_type_support(interface_name, interface_type, NULL);

    return (found == NULL) ? NULL : found->data;
}

void *get_type_support_library(const char *interface_name, const char *interface_type)
{
    static uint8_t library; /* apps only compare its address with NULL */

    return (get_type_info(interface_name, interface_type) == NULL) ? NULL : &library;
}

/* Names. */

/** Characters up to a dot or the end. */
static size_t segment_length(const char *name)
{
    size_t length = 0U;

    while ((name[length] != '.') && (name[length] != '\0')) {
        ++length;
    }
    return length;
}

/** Find a field by the first so many characters of a name. */
static const MemberInfo_t *find_member(const TypeInfo_t *type, const char *name, size_t length)
{
    const MemberInfo_t *found = NULL;
    size_t low = 0U;
    size_t high = type->member_count_;

    while ((found == NULL) && (low < high)) {
        const size_t middle = low + ((high - low) / 2U);
        const char *const candidate = type->members_[middle].name_;
        const int order = strncmp(candidate, name, length);

        if (order < 0) {
            low = middle + 1U;
        } else if ((order > 0) || (candidate[length] != '\0')) {
            high = middle;
        } else {
            found = &type->members_[middle];
        }
    }
    return found;
}

/** Read an index of so many digits; false where it is none, or as large as the limit. */
static bool read_index(const char *digits, size_t length, uint32_t limit, uint32_t *index)
{
    uint64_t value = 0U;
    bool valid = (length > 0U);
    size_t i;

    for (i = 0U; valid && (i < length); ++i) {
        valid = (digits[i] >= '0') && (digits[i] <= '9');
        value = (value * 10U) + (uint64_t)(uint8_t)digits[i] - (uint64_t)(uint8_t)'0';
        valid = valid && (value < limit);
    }
    *index = valid ? (uint32_t)value : 0U;
    return valid;
}

/** Elements that a sequence or array holds now; never more than it can. */
static uint32_t count_of(const uint8_t *message, const place_t *place)
{
    uint32_t count = place->member->array_size_;

    if (place->member->is_sequence_) {
        (void)memcpy(&count, &message[place->offset], sizeof(count));
        if (count > place->member->array_size_) {
            count = place->member->array_size_;
        }
    }
    return count;
}

/** Follow a name from a message to a field or element; false where it leads nowhere. */
static bool find(const uint8_t *message, const TypeInfo_t *ti, const char *name, place_t *place)
{
    const TypeInfo_t *type = ti;
    const char *rest = name;
    bool found = (message != NULL) && (ti != NULL) && (name != NULL);

    (void)memset(place, 0, sizeof(*place));
    while (found && (rest != NULL)) {
        size_t length = segment_length(rest);

        place->member = (type == NULL) ? NULL : find_member(type, rest, length);
        found = (place->member != NULL);
        if (found) {
            place->offset += place->member->offset_;
            place->whole = (place->member->array_size_ > 0U);
            type = place->member->members_;
            rest = (rest[length] == '.') ? &rest[length + 1U] : NULL;
        }
        if (found && place->whole && (rest != NULL)) {
            uint32_t index;

            length = segment_length(rest);
            found = read_index(rest, length, count_of(message, place), &index);
            place->offset += place->member->first_ + ((size_t)index * place->member->size_);
            place->whole = false;
            rest = (rest[length] == '.') ? &rest[length + 1U] : NULL;
        }
    }
    return found;
}

/** Give an app's variable, which nothing was found for, a value all the same. */
static void clear(void *value, size_t size)
{
    if ((value != NULL) && (EDORAS_KEEP_VALUES == 0)) {
        (void)memset(value, 0, size);
    }
}

/* Whole messages. */

edoras_status_t create_msg_into(const TypeInfo_t *ti, void *message, size_t size)
{
    edoras_status_t status = EDORAS_ARGUMENT;

    if ((ti != NULL) && (message != NULL) && (size >= ti->size_of_)) {
        ti->init_function(message);
        status = EDORAS_OK;
    }
    return status;
}

/** Take the next of a row of things in turn; NULL where there is no such row. */
static uint8_t *next_of(uint8_t *things, size_t size, uint32_t *turn)
{
    uint8_t *thing = NULL;

    if (things != NULL) {
        thing = &things[(size_t)*turn * size];
        *turn = (*turn + 1U) % EDORAS_POOL;
    }
    return thing;
}

static uint8_t *next_message(const TypeInfo_t *ti)
{
    return ((ti == NULL) || (ti->pool == NULL))
               ? NULL
               : next_of(ti->pool->messages, ti->size_of_, &ti->pool->next_message);
}

uint8_t *create_msg(const TypeInfo_t *ti)
{
    uint8_t *const message = next_message(ti);

    if (message != NULL) {
        ti->init_function(message);
    }
    return message;
}

/** Which byte of a length of the envelope holds the bits from 8 * place on. */
static size_t envelope_byte(size_t place)
{
#if EDORAS_ENVELOPE_BIG_ENDIAN
    return ((size_t)EDORAS_ENVELOPE_WORD - 1U) - place;
#else
    return place;
#endif
}

static uint64_t read_length(const uint8_t *bytes)
{
    uint64_t value = 0U;
    size_t i;

    for (i = 0U; i < (size_t)EDORAS_ENVELOPE_WORD; ++i) {
        value |= (uint64_t)bytes[envelope_byte(i)] << (8U * i);
    }
    return value;
}

static void write_length(uint8_t *bytes, uint64_t value)
{
    size_t i;

    for (i = 0U; i < (size_t)EDORAS_ENVELOPE_WORD; ++i) {
        bytes[envelope_byte(i)] = (uint8_t)((value >> (8U * i)) & 0xFFU);
    }
}

edoras_status_t from_uint_buffer_to_msg_pointer_into(const uint8_t *buffer, size_t size, size_t offset,
                                                     const TypeSupport_t *ts, const TypeInfo_t *ti,
                                                     void *message, size_t message_size)
{
    edoras_status_t status = create_msg_into(ti, message, message_size);

    (void)ts;
    if (buffer == NULL) {
        status = EDORAS_ARGUMENT;
    } else if (status != EDORAS_OK) {
        /* There is no message to read into. */
    } else if ((offset > size) || ((size - offset) < ENVELOPE_SIZE)) {
        status = EDORAS_TRUNCATED;
    } else {
        const uint8_t *const envelope = &buffer[offset];
        const uint64_t length = read_length(envelope);

        if (length > (size - offset - ENVELOPE_SIZE)) {
            status = EDORAS_TRUNCATED;
        } else {
            status = ti->decode(message, &envelope[ENVELOPE_SIZE], (size_t)length);
        }
    }
    return status;
}

/** Bytes that may be read where nobody says: those of the packet, or of the longest message. */
static size_t trusted_size(const uint8_t *buffer, size_t offset, const TypeInfo_t *ti)
{
    size_t size = offset + ti->buffer_size;

    if (offset >= SHORTEST_HEADER_SIZE) {
        size = (((size_t)buffer[4] << 8U) | buffer[5]) + PRIMARY_HEADER_SIZE + 1U;
    }
    return size;
}

uint8_t *from_uint_buffer_to_msg_pointer(const uint8_t *buffer, size_t offset, const TypeSupport_t *ts,
                                         const TypeInfo_t *ti, size_t *buffer_size)
{
    uint8_t *message = (buffer == NULL) ? NULL : next_message(ti);

    if (message != NULL) {
        const size_t size = trusted_size(buffer, offset, ti);

        if (from_uint_buffer_to_msg_pointer_into(buffer, size, offset, ts, ti, message, ti->size_of_) !=
            EDORAS_OK) {
            message = NULL;
        }
    }
    if (buffer_size != NULL) {
        *buffer_size = (message == NULL) ? 0U : ti->size_of_;
    }
    return message;
}

edoras_status_t from_msg_pointer_to_uint_buffer_into(const uint8_t *message, const TypeSupport_t *ts,
                                                     const TypeInfo_t *ti, uint8_t *buffer, size_t size,
                                                     size_t *buffer_size)
{
    edoras_status_t status = EDORAS_ARGUMENT;
    size_t length = 0U;

    (void)ts;
    if ((message == NULL) || (ti == NULL) || (buffer == NULL)) {
        /* There is nothing to write, or nowhere to write it. */
    } else if (size < ENVELOPE_SIZE) {
        status = EDORAS_NO_SPACE;
    } else {
        status = ti->encode(message, &buffer[ENVELOPE_SIZE], size - ENVELOPE_SIZE, &length);
#if EDORAS_ENVELOPE_WORD == 1
        if ((status == EDORAS_OK) && (length > UINT8_MAX)) {
            status = EDORAS_NO_SPACE;
        }
#endif
    }
    if (status == EDORAS_OK) {
        write_length(&buffer[0], length);
        write_length(&buffer[EDORAS_ENVELOPE_WORD], length);
    }
    if (buffer_size != NULL) {
        *buffer_size = (status == EDORAS_OK) ? (ENVELOPE_SIZE + length) : 0U;
    }
    return status;
}

uint8_t *from_msg_pointer_to_uint_buffer(uint8_t *message, const TypeSupport_t *ts, const TypeInfo_t *ti,
                                         size_t *buffer_size)
{
    uint8_t *buffer = NULL;

    if (buffer_size != NULL) {
        *buffer_size = 0U;
    }
    if ((ti != NULL) && (ti->pool != NULL)) {
        buffer = next_of(ti->pool->buffers, ti->buffer_size, &ti->pool->next_buffer);
    }
    if ((buffer != NULL) && (from_msg_pointer_to_uint_buffer_into(message, ts, ti, buffer, ti->buffer_size,
                                                                  buffer_size) != EDORAS_OK)) {
        buffer = NULL;
    }
    return buffer;
}

/* Sequences. */

bool get_sequence_size(const uint8_t *message, const TypeInfo_t *ti, const char *name, size_t *size)
{
    place_t place;
    const bool found = find(message, ti, name, &place) && place.whole && (size != NULL);

    if (found) {
        *size = count_of(message, &place);
    } else {
        clear(size, sizeof(*size));
    }
    return found;
}

bool resize_sequence(uint8_t *message, const TypeInfo_t *ti, const char *name, size_t size)
{
    place_t place;
    const bool found = find(message, ti, name, &place) && place.whole && place.member->is_sequence_ &&
                       (size <= place.member->array_size_);

    if (found) {
        const MemberInfo_t *const member = place.member;
        const uint32_t count = (uint32_t)size;
        uint32_t i;

        for (i = count_of(message, &place); i < count; ++i) {
            uint8_t *const element = &message[place.offset + member->first_ + ((size_t)i * member->size_)];

            if (member->members_ == NULL) {
                (void)memset(element, 0, member->size_);
            } else {
                member->members_->init_function(element);
            }
        }
        (void)memcpy(&message[place.offset], &count, sizeof(count));
    }
    return found;
}

/* Values. */

/** Find a single value of a kind. */
static bool find_value(const uint8_t *message, const TypeInfo_t *ti, const char *name, edoras_kind_t kind,
                       place_t *place)
{
    return find(message, ti, name, place) && !place->whole && (place->member->type_id_ == kind);
}

static bool get_value(const uint8_t *message, const TypeInfo_t *ti, const char *name, edoras_kind_t kind,
                      void *value, size_t size)
{
    place_t place;
    const bool found = find_value(message, ti, name, kind, &place) && (value != NULL);

    if (found) {
        (void)memcpy(value, &message[place.offset], size);
    } else {
        clear(value, size);
    }
    return found;
}

static bool set_value(uint8_t *message, const TypeInfo_t *ti, const char *name, edoras_kind_t kind,
                      const void *value, size_t size)
{
    place_t place;
    const bool found = find_value(message, ti, name, kind, &place);

    if (found) {
        (void)memcpy(&message[place.offset], value, size);
    }
    return found;
}

/** Copy a string, whose characters have so many bytes each, and end it; false where it does not fit. */
static bool get_text(const uint8_t *message, const TypeInfo_t *ti, const char *name, edoras_kind_t kind,
                     void *value, size_t capacity, size_t width)
{
    place_t place;
    uint32_t count = 0U;
    bool found = find_value(message, ti, name, kind, &place) && (value != NULL);

    if (found) {
        (void)memcpy(&count, &message[place.offset], sizeof(count));
        found = (count < capacity) && (count < place.member->string_size_);
    }
    if (found) {
        (void)memset(value, 0, (count + (size_t)1U) * width);
        (void)memcpy(value, &message[place.offset + STRING_DATA], count * width);
    } else {
        clear(value, capacity * width);
    }
    return found;
}

bool get_const_char_into(const uint8_t *message, const TypeInfo_t *ti, const char *name, char *value,
                         size_t size)
{
    return get_text(message, ti, name, EDORAS_KIND_STRING, value, size, sizeof(*value));
}

bool get_const_char(const uint8_t *message, const TypeInfo_t *ti, const char *name,
                    char value[EDORAS_CONST_CHAR_MAX_SIZE])
{
    return get_const_char_into(message, ti, name, value, EDORAS_CONST_CHAR_MAX_SIZE);
}

bool get_const_char16(const uint8_t *message, const TypeInfo_t *ti, const char *name,
                      uint16_t value[EDORAS_CONST_CHAR_MAX_SIZE])
{
    return get_text(message, ti, name, EDORAS_KIND_WSTRING, value, EDORAS_CONST_CHAR_MAX_SIZE,
                    sizeof(*value));
}

/** Put a string of so many characters into its place. */
static void put_text(uint8_t *message, const place_t *place, const void *value, uint32_t count, size_t width)
{
    uint8_t *const data = &message[place->offset + STRING_DATA];

    (void)memcpy(&message[place->offset], &count, sizeof(count));
    (void)memcpy(data, value, count * width);
    (void)memset(&data[count * width], 0, width);
}

bool set_const_char(uint8_t *message, const TypeInfo_t *ti, const char *name, const char *value)
{
    place_t place;
    bool found = find_value(message, ti, name, EDORAS_KIND_STRING, &place) && (value != NULL);
    uint32_t count = 0U;

    while (found && (value[count] != '\0')) {
        ++count;
        found = (count < place.member->string_size_);
    }
    if (found) {
        put_text(message, &place, value, count, sizeof(*value));
    }
    return found;
}

bool set_const_char16(uint8_t *message, const TypeInfo_t *ti, const char *name, const uint16_t *value)
{
    place_t place;
    bool found = find_value(message, ti, name, EDORAS_KIND_WSTRING, &place) && (value != NULL);
    uint32_t count = 0U;

    while (found && (value[count] != 0U)) {
        ++count;
        found = (count < place.member->string_size_);
    }
    if (found) {
        put_text(message, &place, value, count, sizeof(*value));
    }
    return found;
}

bool get_bool(const uint8_t *message, const TypeInfo_t *ti, const char *name, bool *value)
{
    return get_value(message, ti, name, EDORAS_KIND_BOOL, value, sizeof(*value));
}

bool get_byte(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT8, value, sizeof(*value));
}

bool get_char(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT8, value, sizeof(*value));
}

bool get_uint8(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT8, value, sizeof(*value));
}

bool get_int8(const uint8_t *message, const TypeInfo_t *ti, const char *name, int8_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_INT8, value, sizeof(*value));
}

bool get_uint16(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint16_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT16, value, sizeof(*value));
}

bool get_int16(const uint8_t *message, const TypeInfo_t *ti, const char *name, int16_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_INT16, value, sizeof(*value));
}

bool get_uint32(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint32_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT32, value, sizeof(*value));
}

bool get_int32(const uint8_t *message, const TypeInfo_t *ti, const char *name, int32_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_INT32, value, sizeof(*value));
}

bool get_uint64(const uint8_t *message, const TypeInfo_t *ti, const char *name, uint64_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_UINT64, value, sizeof(*value));
}

bool get_int64(const uint8_t *message, const TypeInfo_t *ti, const char *name, int64_t *value)
{
    return get_value(message, ti, name, EDORAS_KIND_INT64, value, sizeof(*value));
}

bool get_float32(const uint8_t *message, const TypeInfo_t *ti, const char *name, float *value)
{
    return get_value(message, ti, name, EDORAS_KIND_FLOAT32, value, sizeof(*value));
}

bool get_float64(const uint8_t *message, const TypeInfo_t *ti, const char *name, double *value)
{
    return get_value(message, ti, name, EDORAS_KIND_FLOAT64, value, sizeof(*value));
}

bool set_bool(uint8_t *message, const TypeInfo_t *ti, const char *name, bool value)
{
    return set_value(message, ti, name, EDORAS_KIND_BOOL, &value, sizeof(value));
}

bool set_byte(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT8, &value, sizeof(value));
}

bool set_char(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT8, &value, sizeof(value));
}

bool set_uint8(uint8_t *message, const TypeInfo_t *ti, const char *name, uint8_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT8, &value, sizeof(value));
}

bool set_int8(uint8_t *message, const TypeInfo_t *ti, const char *name, int8_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_INT8, &value, sizeof(value));
}

bool set_uint16(uint8_t *message, const TypeInfo_t *ti, const char *name, uint16_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT16, &value, sizeof(value));
}

bool set_int16(uint8_t *message, const TypeInfo_t *ti, const char *name, int16_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_INT16, &value, sizeof(value));
}

bool set_uint32(uint8_t *message, const TypeInfo_t *ti, const char *name, uint32_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT32, &value, sizeof(value));
}

bool set_int32(uint8_t *message, const TypeInfo_t *ti, const char *name, int32_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_INT32, &value, sizeof(value));
}

bool set_uint64(uint8_t *message, const TypeInfo_t *ti, const char *name, uint64_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_UINT64, &value, sizeof(value));
}

bool set_int64(uint8_t *message, const TypeInfo_t *ti, const char *name, int64_t value)
{
    return set_value(message, ti, name, EDORAS_KIND_INT64, &value, sizeof(value));
}

bool set_float32(uint8_t *message, const TypeInfo_t *ti, const char *name, float value)
{
    return set_value(message, ti, name, EDORAS_KIND_FLOAT32, &value, sizeof(value));
}

bool set_float64(uint8_t *message, const TypeInfo_t *ti, const char *name, double value)
{
    return set_value(message, ti, name, EDORAS_KIND_FLOAT64, &value, sizeof(value));
}

/* What else edoras_core has. */

void debug_parse_buffer(uint8_t *message, const TypeInfo_t *ti)
{
    (void)message;
    (void)ti;
}

void printBuffer(uint8_t *data, size_t data_size, const char *text)
{
    (void)data;
    (void)data_size;
    (void)text;
}

/** Whether an address lies in a block of so many bytes. */
static bool lies_in(uintptr_t address, const uint8_t *block, size_t size)
{
    return (address >= (uintptr_t)block) && ((address - (uintptr_t)block) < size);
}

void *edoras_heap_only(void *pointer)
{
    const uintptr_t address = (uintptr_t)pointer;
    bool pooled = false;
    size_t i;

    for (i = 0U; !pooled && (i < edoras_types_count); ++i) {
        const TypeInfo_t *const type = edoras_types[i].data;

        pooled = (type->pool != NULL) &&
                 (lies_in(address, type->pool->messages, EDORAS_POOL * type->size_of_) ||
                  lies_in(address, type->pool->buffers, EDORAS_POOL * type->buffer_size));
    }
    return pooled ? NULL : pointer;
}
