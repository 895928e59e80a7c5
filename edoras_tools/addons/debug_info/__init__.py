"""``edoras structs``: C structs from debug information (DWARF in ELF files) and headers."""
