/**
 * What the functions of edoras_core know of a message type: the table of its fields, by name.
 *
 * Names end in _ where ROS's introspection has the same thing under that name, for apps look at some of them.
 */
#ifndef EDORAS_CORE_TYPES_H
#define EDORAS_CORE_TYPES_H

#include "edoras_core/cdr.h"

typedef enum {
    EDORAS_KIND_BOOL,
    EDORAS_KIND_UINT8, /**< byte and char too */
    EDORAS_KIND_INT8,
    EDORAS_KIND_UINT16,
    EDORAS_KIND_INT16,
    EDORAS_KIND_UINT32,
    EDORAS_KIND_INT32,
    EDORAS_KIND_UINT64,
    EDORAS_KIND_INT64,
    EDORAS_KIND_FLOAT32,
    EDORAS_KIND_FLOAT64,
    EDORAS_KIND_STRING,
    EDORAS_KIND_WSTRING,
    EDORAS_KIND_MESSAGE
} edoras_kind_t;

typedef struct TypeInfo TypeInfo_t;

/** One field. Offsets and sizes are bytes. */
typedef struct {
    const char *name_;
    edoras_kind_t type_id_;
    bool is_sequence_;          /**< the field starts with its count, as uint32_t */
    uint32_t string_size_;      /**< most characters or units of a string, and one; 0 for other kinds */
    const TypeInfo_t *members_; /**< the type of a nested message; NULL otherwise */
    size_t offset_;             /**< of the field, from the start of its message */
    size_t first_;              /**< of the first element, from the field: past the count of a sequence */
    size_t size_;               /**< of one element */
    uint32_t array_size_;       /**< elements of an array, most of a sequence; 0 for a single value */
} MemberInfo_t;

/** The messages that create_msg and the parser hand out in turn, and the buffers that the serialiser does. */
typedef struct {
    uint8_t *messages; /**< EDORAS_POOL of them; NULL where the library was made without */
    uint8_t *buffers;  /**< EDORAS_POOL of them, each of buffer_size bytes */
    uint32_t next_message;
    uint32_t next_buffer;
} edoras_pool_t;

/** One message type. */
struct TypeInfo {
    const char *message_namespace_; /**< as "geometry_msgs" */
    const char *message_name_;      /**< as "Pose" */
    uint32_t member_count_;
    size_t size_of_;                /**< of the struct */
    size_t buffer_size;             /**< of the longest message, EDORAS envelope included */
    const MemberInfo_t *members_;   /**< sorted by name */
    void (*init_function)(void *message);
    edoras_status_t (*encode)(const void *message, uint8_t *buffer, size_t size, size_t *length);
    edoras_status_t (*decode)(void *message, const uint8_t *cdr, size_t length);
    edoras_pool_t *pool;
};

/** Kept apart as edoras_core does; it says nothing that TypeInfo_t does not. */
typedef struct {
    const char *typesupport_identifier;
    const TypeInfo_t *data;
} TypeSupport_t;

/** One entry for every type of this library, sorted by package, then name. */
extern const TypeSupport_t edoras_types[];
extern const size_t edoras_types_count;

#endif
