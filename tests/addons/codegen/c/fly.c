/**
 * Gives a flight app the commands of a file, and writes what it gives away after each.
 *
 *     fly COMMANDS OUTPUTS
 *
 * A record of either file is its length as u32 little-endian, and its bytes. As on cFE's bus, a command lies in a block
 * as long as its header says, so that a sanitizer sees a step outside.
 */
#include "app.h"

#include <stdio.h>
#include <stdlib.h>

static uint8_t command[1U << 17U];

int main(int count, char **arguments)
{
    FILE *const commands = fopen((count == 3) ? arguments[1] : "", "rb");
    FILE *const outputs = fopen((count == 3) ? arguments[2] : "", "wb");
    uint8_t head[4];

    if ((commands == NULL) || (outputs == NULL))
        return 1;
    AppInit();
    while (fread(head, 1U, sizeof(head), commands) == sizeof(head)) {
        const size_t length = head[0] | ((size_t)head[1] << 8U) | ((size_t)head[2] << 16U);
        size_t size;
        uint8_t *block;
        const void *output;

        if ((length < 8U) || (length > sizeof(command)) || (fread(command, 1U, length, commands) != length))
            return 1;
        size = (((size_t)command[4] << 8U) | command[5]) + 7U;
        if (size < 8U)
            size = 8U;
        block = malloc(size);
        if (block == NULL)
            return 1;
        memset(block, 0xA5, size);
        memcpy(block, command, (length < size) ? length : size);
        AppCommand((CFE_SB_Buffer_t *)(void *)block);
        free(block);
        output = AppOutput(&size);
        for (size_t i = 0U; i < 4U; i++)
            head[i] = (uint8_t)(size >> (8U * i));
        fwrite(head, 1U, sizeof(head), outputs);
        fwrite(output, 1U, size, outputs);
        AppHousekeeping();
    }
    fclose(commands);
    return fclose(outputs);
}
