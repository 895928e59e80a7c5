/** Messages, and buffers, of each type that create_msg and its like hand out in turn. */
#define EDORAS_POOL ${pool}U

/** Bytes of each of the two lengths of the EDORAS envelope, and whether their first byte is the highest. */
#define EDORAS_ENVELOPE_WORD $word
#define EDORAS_ENVELOPE_BIG_ENDIAN $big_endian

/** Whether a get_ function that fails leaves the app's variable as it was; otherwise it writes 0. */
#define EDORAS_KEEP_VALUES $keep_values
