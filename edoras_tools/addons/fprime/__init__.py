"""F Prime: the link between flight software and its ground system, read and judged."""
