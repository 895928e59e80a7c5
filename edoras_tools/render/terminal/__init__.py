"""What all views use: consoles, colours, tables, progress."""
