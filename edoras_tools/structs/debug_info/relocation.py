"""Applies relocations of debug information in object files, for machines that pyelftools does not support."""

from __future__ import annotations

from typing import Any, Final

_WORDS: Final = {
    "EM_PPC": {1: 4, 24: 4},
    "EM_SPARC": {3: 4, 23: 4, 32: 8, 54: 8},
    "EM_SPARC32PLUS": {3: 4, 23: 4},
    "EM_SPARCV9": {3: 4, 23: 4, 32: 8, 54: 8},
    "EM_68K": {1: 4},
    "EM_MICROBLAZE": {1: 4},
    "EM_RISCV": {1: 4, 2: 8},
}
"""By machine the relocation types that write a whole word (R_PPC_ADDR32, R_SPARC_UA32 and so on), and its
bytes; others are of code addresses, which say nothing of types."""


def relocated(elf: Any, data: bytes) -> bytes | None:
    """Return the file with the relocations of its debug sections applied; None: pyelftools can do it.

    Args:
        elf: the file, as pyelftools opened it.
        data: its bytes.
    """
    words = _WORDS.get(elf["e_machine"])
    if words is None:
        return None
    out = bytearray(data)
    order = "little" if elf.little_endian else "big"
    for section in elf.iter_sections("SHT_RELA"):
        target = elf.get_section(section["sh_info"])
        if not target.name.startswith(".debug_"):
            continue
        symbols = elf.get_section(section["sh_link"])
        for item in section.iter_relocations():
            size = words.get(item["r_info_type"])
            at = item["r_offset"]
            if size is None or at + size > target["sh_size"]:
                continue
            value = symbols.get_symbol(item["r_info_sym"])["st_value"] + item["r_addend"]
            place = target["sh_offset"] + at
            out[place : place + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, order)
    return bytes(out)
