    if (message != NULL) {
        edoras_reader_t reader;

        edoras_reader_open(&reader, cdr, length);
        ${name}__read(&reader, message);
        status = edoras_reader_close(&reader, ${most_trailing}U);
        if (status != EDORAS_OK) {
            ${name}__init(message);
        }
    }
    return status;
