"""Common parts of all views: consoles, colours, tables, progress."""
