    edoras_writer_open(&writer, (message == NULL) ? NULL : buffer, size);
    if (message != NULL) {
        ${name}__write(&writer, message);
    }
    return edoras_writer_close(&writer, length);
