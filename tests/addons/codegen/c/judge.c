/**
 * Reads messages from a file, decodes and encodes each, and sees that the same bytes come out; then spoils them, so
 * many times, and does it again. Bytes and messages lie in blocks of exactly their size, so that a sanitizer sees a
 * step outside.
 *
 *     judge FILE TIMES
 *
 * A record of the file is package NUL name NUL, the length as u32 little-endian, and the CDR.
 */
#include <edoras_core/interface.h>

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t dice = 0x9E3779B97F4A7C15U;

static uint32_t roll(uint32_t limit)
{
    dice ^= dice << 13U;
    dice ^= dice >> 7U;
    dice ^= dice << 17U;
    return (uint32_t)((dice >> 20U) % limit);
}

static void *block(size_t size)
{
    void *const made = malloc(size);

    if (made == NULL) {
        abort();
    }
    return made;
}

/** Decode so many bytes; where that works, encode again into a buffer of some size, and decode that. */
static edoras_status_t pass(const TypeInfo_t *type, const uint8_t *cdr, size_t length, size_t room, bool same)
{
    uint8_t *const input = block(length);
    uint8_t *const output = block(room);
    void *const message = block(type->size_of_);
    edoras_status_t status;
    size_t written = 0U;

    memset(message, 0xA5, type->size_of_);
    memcpy(input, cdr, length);
    status = type->decode(message, input, length);
    if (status == EDORAS_OK) {
        const edoras_status_t encoded = type->encode(message, output, room, &written);

        if ((encoded != EDORAS_OK) != (written == 0U)) {
            abort();
        }
        if (same && ((encoded != EDORAS_OK) || (written != length) || (memcmp(output, input, length) != 0))) {
            fprintf(stderr, "%s/%s: other bytes\n", type->message_namespace_, type->message_name_);
            abort();
        }
        if ((room >= type->buffer_size) && ((encoded != EDORAS_OK) || (written > type->buffer_size))) {
            abort();
        }
    }
    /* What the message is made of may be wrong too: sizes above the bounds. */
    for (size_t i = 0U; (i + 4U) <= type->size_of_; i += 4U * (1U + roll(8U))) {
        const uint32_t odd = (roll(2U) == 0U) ? roll(300U) : 0xFFFFFFFFU - roll(3U);

        memcpy((uint8_t *)message + i, &odd, sizeof(odd));
    }
    (void)type->encode(message, output, room, &written);
    if (!same) {
        uint8_t *const any = message;
        char name[3][24] = {"", "position.0", "header.frame_id"};
        char text[EDORAS_CONST_CHAR_MAX_SIZE];
        double value;

        for (size_t i = 0U; i < 23U; ++i) {
            name[0][i] = "abcdehimnoprstxyz_.0123456789"[roll(29U)];
        }
        for (size_t i = 0U; i < 3U; ++i) {
            (void)get_float64(any, type, name[i], &value);
            (void)get_const_char(any, type, name[i], text);
            (void)set_const_char(any, type, name[i], "text");
            (void)resize_sequence(any, type, name[i], roll(40U));
        }
    }
    free(message);
    free(output);
    free(input);
    return status;
}

int main(int count, char **arguments)
{
    static uint8_t file[1U << 22U];
    FILE *const stream = fopen((count == 3) ? arguments[1] : "", "rb");
    const long times = (count == 3) ? strtol(arguments[2], NULL, 10) : 0;
    const size_t size = (stream == NULL) ? 0U : fread(file, 1U, sizeof(file), stream);
    unsigned long statuses[EDORAS_NO_SPACE + 1] = {0U};

    for (size_t at = 0U; at < size;) {
        const char *const package = (const char *)&file[at];
        const char *const name = package + strlen(package) + 1U;
        const uint8_t *const head = (const uint8_t *)name + strlen(name) + 1U;
        const size_t length = head[0] | ((size_t)head[1] << 8U) | ((size_t)head[2] << 16U);
        const TypeInfo_t *const type = get_type_info(package, name);

        if (type == NULL) {
            abort();
        }
        if (pass(type, &head[4], length, type->buffer_size, true) != EDORAS_OK) {
            abort();
        }
        for (long i = 0; i < times; ++i) {
            uint8_t *const spoilt = block(length + 8U);
            const size_t cut = (roll(3U) == 0U) ? roll((uint32_t)length + 9U) : length;

            memset(spoilt, (int)roll(256U), length + 8U);
            memcpy(spoilt, &head[4], length);
            for (uint32_t hits = roll(4U); hits > 0U; --hits) {
                spoilt[roll((uint32_t)length)] = (uint8_t)((roll(2U) == 0U) ? roll(256U) : roll(3U) * 0x7FU);
            }
            ++statuses[pass(type, spoilt, cut, roll((uint32_t)type->buffer_size + 1U), false)];
            free(spoilt);
        }
        at = (size_t)(&head[4 + length] - file);
    }
    fclose(stream);
    for (size_t i = 0U; i <= EDORAS_NO_SPACE; ++i) {
        printf("%s: %lu\n", edoras_status_text((edoras_status_t)i), statuses[i]);
    }
    return 0;
}
