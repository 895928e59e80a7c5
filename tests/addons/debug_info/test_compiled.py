"""The compiler is the judge: where it puts members, and what it reads there, is what we say."""

import random
import shutil
import struct
import subprocess
from io import BytesIO
from math import isnan

import numpy as np
import pytest
from c_structs import HEAD, draw, program
from msgspec.structs import replace

from edoras_tools.addons.debug_info.dwarf import DebugInfo
from edoras_tools.structs import Structs
from edoras_tools.structs.files import dumps, parse_layout
from edoras_tools.structs.messages import HEAD as HEAD_BYTES
from edoras_tools.structs.shapes import Key

SIZE = 512
"""Bytes that each struct is filled with."""
COUNT = 60
BIG = '__attribute__((scalar_storage_order("big-endian")))'

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def gcc(folder, name, text, *flags):
    """Compile a source; return what came out."""
    source, made = folder / f"{name}.c", folder / name
    source.write_text(text)
    done = subprocess.run(
        ["gcc", "-w", *flags, source, "-o", made], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[:2000]
    return made


def printed(program_file, data):
    """Return what the program says: struct to (its size, [(path, offset, value)])."""
    said = subprocess.run([program_file], input=data, capture_output=True, check=True).stdout.decode()
    found = {}
    for line in said.splitlines():
        words = line.split(" ")
        if len(words) == 2 and words[0].startswith("S"):
            leaves = []
            found[words[0]] = int(words[1]), leaves
        else:
            leaves.append((words[0], int(words[1]), words[2]))
    return found


def bound_to(layout):
    """Return every struct as what lies in packets, a MsgId each."""
    names = [name for name in layout.structs if name.startswith("S") and name[1:].isdigit()]
    keys = {Key(0x0800 + number): name for number, name in enumerate(names)}
    structs = Structs([replace(layout, bindings=keys)])
    return {item.struct.name: item for item in structs.all}, structs.types


def read(bound, types, payload):
    """Return (offset, value) of every value, in the order of the declaration."""
    cdr = bound.encode_one(payload, (0, 0, 0, 0, 0))
    values = types.decode(bound.type, cdr)
    found = []
    for _, value, start, end, member in bound.spans(values, len(payload)):
        items = value if isinstance(value, list) else [value]
        step = (end - start) // len(items)
        found += [
            (-1 if member.bits or member.text else start + i * step, item) for i, item in enumerate(items)
        ]
    return found


def same(said, ours):
    if said.startswith("t"):
        raw = bytes.fromhex(said[1:])
        try:
            return raw.decode() == ours
        except UnicodeDecodeError:
            return bytes(octet if octet < 128 else 63 for octet in raw).decode() == ours
    if isinstance(ours, float):
        theirs = float.fromhex(said)
        return theirs == ours or (isnan(theirs) and isnan(ours))
    return int(said) == ours


def judge(layout, made, said, data, *, places=True):
    bound, types = bound_to(layout)
    assert len(bound) == len(made) == len(said)
    checked = 0
    for number, item in enumerate(made):
        size, leaves = said[item.name]
        assert layout.structs[item.name].size == size, item.text
        payload = data[number * SIZE : (number + 1) * SIZE].ljust(size, b"\0")[:size]
        ours = read(bound[item.name], types, payload)
        for (path, offset, value), (start, got) in zip(leaves, ours, strict=True):
            assert same(value, got), (item.text, path, value, got)
            assert not places or offset < 0 or offset == start, (item.text, path, offset, start)
            checked += 1
    return checked


def noise(seed):
    chance = random.Random(seed)
    return bytes(
        chance.choice([0, 1, 255, chance.randrange(256), chance.randrange(32, 127)])
        for _ in range(COUNT * SIZE)
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Structs, what a program says of them, and the bytes that it read."""
    folder = tmp_path_factory.mktemp("drawn")
    made, data = draw(1, COUNT), noise(2)
    text = program(made, SIZE)
    return made, printed(gcc(folder, "program", text), data), data, text


@pytest.mark.quick("2")
@pytest.mark.parametrize("version", [2, 3, 4, 5])
def test_offsets_sizes_and_values_are_the_compilers(version, drawn, tmp_path):
    made, said, data, text = drawn
    flags = ("-g", f"-gdwarf-{version}", "-gstrict-dwarf", "-fno-eliminate-unused-debug-types", "-c")
    info = DebugInfo(gcc(tmp_path, "made.o", text, *flags))
    layout, _ = info.layout([item.name for item in made], {}, "cfs_msgs")
    assert not info.warnings
    assert judge(layout, made, said, data) > 900
    again = parse_layout(dumps(layout).encode(), "again")
    assert (again.structs, again.enums) == (layout.structs, layout.enums)


@pytest.mark.long
def test_without_offsets_a_layout_is_arranged_as_by_the_compiler(drawn, tmp_path):
    """What people write by hand: no offset, no size; packed where the compiler packed."""
    import re

    made, _, _, text = drawn
    flags = ("-g", "-fno-eliminate-unused-debug-types", "-c")
    layout, _ = DebugInfo(gcc(tmp_path, "made.o", text, *flags)).layout(
        [item.name for item in made if "    " not in item.text and "  struct  {" not in item.text], {}, "x"
    )
    packed = {item.name for item in made if "packed" in item.text}
    lines = []
    for line in dumps(layout).splitlines():
        if re.match(r"    size: ", line):
            continue
        lines.append(re.sub(r" @[\d.]+", "", line))
        if match := re.match(r"  (S\d+):$", line):
            lines += ["    packed: true"] * (match[1] in packed)
    anonymous = {item.name for item in made if re.search(r"^  (struct|union)  \{", item.text, re.MULTILINE)}
    again = parse_layout("\n".join(lines).encode(), "by hand")
    compared = 0
    for name, ours in again.structs.items():
        if uses(layout, name) & anonymous:
            continue  # members of what has no name are written with offsets
        assert ours == layout.structs[name], next(item.text for item in made if item.name == name)
        compared += 1
    assert compared > 15


def uses(layout, name):
    found, left = set(), [name]
    while left:
        one = left.pop()
        if one in layout.structs and one not in found:
            found.add(one)
            left += [str(member.type) for member in layout.structs[one].members]
    return found


@pytest.mark.long
def test_big_endian_values_are_what_the_compiler_reads_turned_round(tmp_path):
    made, data = draw(3, COUNT, BIG), noise(4)
    said = printed(gcc(tmp_path, "program", program(made, SIZE, BIG)), data)
    plain = "".join([HEAD, *(item.text for item in made)]).replace(BIG, "")
    flags = ("-g", "-fno-eliminate-unused-debug-types", "-c")
    info = DebugInfo(gcc(tmp_path, "made.o", plain, *flags))
    layout = replace(info.layout([item.name for item in made], {}, "cfs_msgs")[0], byte_order="big")
    assert judge(layout, made, said, data, places=False) > 800


def test_other_word_sizes(tmp_path):
    """The compiler's own offsetof, for a target that this machine need not run."""
    from elftools.elf.elffile import ELFFile

    text = """
    #include <stddef.h>
    typedef unsigned long long u64;
    typedef struct { char a; u64 b; void *p; long n; double d; char t[3]; long double x; } S0;
    S0 s;
    const unsigned places[] = {offsetof(S0, b), offsetof(S0, p), offsetof(S0, n), offsetof(S0, d),
                               offsetof(S0, t), offsetof(S0, x), sizeof(S0)};
    """
    try:
        made = gcc(tmp_path, "made.o", text, "-g", "-m32", "-c")
    except AssertionError:
        pytest.skip("this gcc makes no 32-bit code")
    elf = ELFFile(BytesIO(made.read_bytes()))
    symbol = elf.get_section_by_name(".symtab").get_symbol_by_name("places")[0]
    wanted = struct.unpack_from("<7I", elf.get_section(symbol["st_shndx"]).data(), symbol["st_value"])
    found = DebugInfo(made).layout(["S0"], {}, "x")[0].structs["S0"]
    members = {item.name: item for item in found.members}
    assert wanted == (*(members[name].offset for name in "bpndtx"), found.size)
    assert (str(members["p"].type), members["p"].base, members["x"].dims) == ("uint32", 16, (12,))


@pytest.mark.long
def test_many_packets_at_once_are_as_one_by_one(drawn, tmp_path):
    made, _, data, text = drawn
    layout, _ = DebugInfo(
        gcc(tmp_path, "made.o", text, "-g", "-c", "-fno-eliminate-unused-debug-types")
    ).layout([item.name for item in made], {}, "cfs_msgs")
    buffer = np.frombuffer(data, np.uint8)
    for bound in bound_to(layout)[0].values():
        offset = np.arange(0, 5000, 37)
        heads = np.zeros(len(offset), HEAD_BYTES)
        heads["sequence_count"] = np.arange(len(offset))
        many = bound.encode(buffer, offset, np.full(len(offset), bound.size), heads)
        for index in range(0, len(offset), 23):
            at = int(offset[index])
            one = bound.encode_one(data[at : at + bound.size], (0, 0, index, 0, 0))
            assert many.data[many.start[index] :][: many.size[index]].tobytes() == one
