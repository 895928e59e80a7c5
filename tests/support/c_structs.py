"""C structs drawn at random, and a program that prints where their members lie and what they hold."""

import random
from dataclasses import dataclass, field
from math import prod

SCALARS = {
    "uint8_t": "%ju",
    "int8_t": "%jd",
    "uint16_t": "%ju",
    "int16_t": "%jd",
    "uint32_t": "%ju",
    "int32_t": "%jd",
    "uint64_t": "%ju",
    "int64_t": "%jd",
    "float": "%a",
    "double": "%a",
    "bool": "bool",
    "char": "char",
    "enum Mode": "%jd",
    "enum Small": "%ju",
}
HEAD = """
#include <inttypes.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
enum Mode { IDLE, DRIVE = 5, STOP = -1 };
enum Small { NONE, SOME = 200 } __attribute__((packed));
"""
_MOST = 24
"""Values that a struct inside another brings at the most."""
BITS = {"uint8_t": 8, "uint16_t": 16, "uint32_t": 32, "int32_t": 32, "uint64_t": 64, "int64_t": 64, "bool": 1}


@dataclass
class Made:
    """A struct: its text, its members as (C path, kind), and which of them are no bit-fields."""

    name: str
    text: str = ""
    leaves: list = field(default_factory=list)


class Chance(random.Random):
    """Draws; where bytes are turned round no truths, which are printed by their address."""

    def scalar(self, order):
        return self.choice([kind for kind in SCALARS if not order or kind != "bool"])


def draw(seed, count, order=""):
    """Return structs, each with the text that declares it."""
    chance = Chance(seed)
    made = []
    for number in range(count):
        item = Made(f"S{number}")
        union = chance.random() < 0.1
        packed = chance.random() < 0.25
        lines = []
        members(chance, item, lines, made, "", chance.randint(1, 8), depth=0, union=union, order=order)
        kind = "union" if union else "struct"
        attributes = order + (" __attribute__((packed))" if packed else "")
        item.text = f"typedef {kind} {attributes} {{\n{''.join(lines)}}} S{number};\n"
        made.append(item)
    return made


def members(chance, item, lines, made, prefix, count, *, depth, union, order):
    for number in range(count):
        name = f"{prefix.replace('.', '')}m{number}"
        what = chance.random()
        if what < 0.45:
            scalar(chance, item, lines, name, order)
        elif what < 0.55:
            width = chance.randint(1, 20)
            lines.append(f"  char {name}[{width}];\n")
            item.leaves.append((name, "text", width))
        elif what < 0.72 and not union:
            for part in range(chance.randint(1, 5)):
                kind = chance.choice(list(BITS))
                lines.append(f"  {kind} {name}_{part}:{chance.randint(1, BITS[kind])};\n")
                item.leaves.append((f"{name}_{part}", "bits", "bool" if kind == "bool" else kind))
        elif what < 0.9 and made:
            inner = chance.choice(made[-12:])
            dims = [chance.randint(1, 3) for _ in range(chance.choice([0, 0, 1, 2]))]
            if len(inner.leaves) * prod(dims) > _MOST:
                scalar(chance, item, lines, name, order)
                continue
            lines.append(f"  {inner.name} {name}{''.join(f'[{size}]' for size in dims)};\n")
            for place in places(dims):
                item.leaves += [(f"{name}{place}.{path}", *rest) for path, *rest in inner.leaves]
        elif depth < 2:
            inside = []
            kind = chance.choice(["struct", "union"])
            is_union = kind == "union"
            inner = name.upper()
            members(
                *(chance, item, inside, made, inner, chance.randint(1, 3)),
                depth=depth + 1,
                union=is_union,
                order=order,
            )
            lines.append(f"  {kind} {order} {{\n{''.join(inside)}  }};\n")
        else:
            scalar(chance, item, lines, name, order)


def scalar(chance, item, lines, name, order):
    kind = chance.scalar(order)
    dims = [chance.randint(1, 3) for _ in range(chance.choice([0, 0, 0, 1, 2]))]
    if kind == "char":
        dims = []
    lines.append(f"  {kind} {name}{''.join(f'[{size}]' for size in dims)};\n")
    item.leaves += [(f"{name}{place}", "scalar", kind) for place in places(dims)]


def places(dims):
    """Yield every index of an array, as C writes it."""
    if not dims:
        return [""]
    rest = places(dims[1:])
    return [f"[{index}]{tail}" for index in range(dims[0]) for tail in rest]


def program(made, size, order=""):
    """Return a program that reads bytes for each struct from standard input and prints what they hold."""
    lines = [HEAD, *(item.text for item in made), "int main(void) {\n"]
    for item in made:
        lines.append(
            f"  {{ static union {{ {item.name} s; unsigned char raw[{size} + sizeof({item.name})]; }} u;\n"
        )
        lines.append(f"    if (fread(u.raw, 1, {size}, stdin) != {size}) return 1;\n")
        lines.append(f'    printf("{item.name} %zu\\n", sizeof({item.name}));\n')
        for path, kind, detail in item.leaves:
            place = f"(size_t)((char *)&u.s.{path} - (char *)&u.s)"
            if kind == "text":
                lines.append(f'    printf("{path} %zd t", (ptrdiff_t)-1);\n')
                lines.append(f"    for (int i = 0; i < {detail} && u.s.{path}[i]; i++)")
                lines.append(f' printf("%02x", (unsigned char)u.s.{path}[i]);\n    printf("\\n");\n')
                continue
            where = f'printf("{path} %zd ", (ptrdiff_t)-1)'
            if kind == "scalar" and not order:
                where = f'printf("{path} %zu ", {place})'
            lines.append(f"    {where};\n")
            lines.append(f"    {value(path, kind, detail)}\n")
        lines.append("  }\n")
    return "".join([*lines, "  return 0;\n}\n"])


def value(path, kind, detail):
    if detail == "bool" and kind == "scalar":
        return f'printf("%d\\n", *(unsigned char *)&u.s.{path} != 0);'
    if detail == "bool":
        return f'printf("%d\\n", u.s.{path});'
    if detail == "char":
        return f'printf("%d\\n", (unsigned char)u.s.{path});'
    form = SCALARS[detail]
    if form == "%a":
        return f'printf("%a\\n", (double)u.s.{path});'
    cast = "uintmax_t" if form == "%ju" else "intmax_t"
    return f'printf("{form}\\n", ({cast})u.s.{path});'
