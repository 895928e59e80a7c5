/**
 * For every message type T, named as rosidl names it:
 *
 *     T__init     gives a message the default values of its definition.
 *     T__encode   writes a message to a buffer of a given size, encapsulation and body, little-endian; gives
 *                 the length. T__MAX_CDR bytes are always enough.
 *     T__decode   reads a message of either byte order; where the status is not EDORAS_OK, the message has
 *                 its default values.
 *     T__write    and T__read do the same inside a message that nests T; neither takes NULL.
 *
 * A sequence is a count, size, and as many elements of data as its bound; a string likewise, and ends in NUL.
 * A size above the bound is EDORAS_BOUND to encode, from wherever it came.
 */
$includes
