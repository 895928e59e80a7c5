"""Structs from debug information: DWARF in ELF files."""
