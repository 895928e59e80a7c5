"""Other machines: data that their compilers lay out holds the values that were written in the source."""

import shutil
import subprocess
from io import BytesIO

import pytest
from msgspec.structs import replace

from edoras_tools.addons.debug_info.dwarf import DebugInfo
from edoras_tools.structs import Structs
from edoras_tools.structs.files import dumps, parse_layout
from edoras_tools.structs.shapes import Key

SOURCE = """
typedef unsigned char u8; typedef signed char i8; typedef unsigned short u16; typedef short i16;
typedef unsigned int u32; typedef int i32; typedef unsigned long long u64; typedef long long i64;
enum Signed { SM = -5, SP = 7 };
enum Unsigned { U0, UM = 0xF0000000u };
enum __attribute__((packed)) Small { EM = -3, EP = 100 };
typedef struct {
    u32 a:1; u32 b:5; u32 c:13; u32 d:13; u64 e:40; i64 f:33; i32 g:3; u8 h:7; u8 i:1; i16 j:9; _Bool k:1;
    enum Signed l:5;
} Bits;
typedef struct __attribute__((packed)) {
    u8 a:3; u32 b:17; i32 c:11; u64 d:63; i64 e:64; u16 f:16; u8 g; u32 h; double i; i64 j:37;
} Packed;
typedef struct { u8 x; Packed p; u8 :4; u8 y:4; int :0; u16 z:2; } Mixed;
typedef struct {
    i8 a; u64 b; i16 c[2][3]; enum Signed s; enum Unsigned u; enum Small e; float f; double d; _Bool t;
    char n[2][5]; Bits bits; Mixed m[2]; union { u32 w; u16 half; };
    struct { i16 deep; struct { u8 q[3]; }; }; long l;
} Top;
__attribute__((section(".values"))) Top top = {
    -7, 0x1122334455667788ull, {{1, -2, 3}, {-4, 5, -6}}, SM, UM, EM, 1.5f, -2.25, 1, {"abc", "defg"},
    {1, 21, 5000, 4099, 0x98badcfe12ull, -3000000000ll, -2, 99, 1, -200, 1, SM},
    {{200, {5, 100000, -777, 0x3edcba9876543210ull, -2, 60000, 250, 0xdeadbeef, 0.125, -60000000000ll}, 9, 2},
     {100, {2, 131071, 1023, 1, 0x7fffffffffffffffll, 1, 2, 3, -0.5, 68719476735ll}, 15, 3}},
    {.w = 0x01020304u}, {-300, {{7, 8, 9}}}, -123456
};
"""
NAMES = "abcdefghij"
VALUES = {
    "a": -7,
    "b": 0x1122334455667788,
    "c": [1, -2, 3, -4, 5, -6],
    "s": -5,
    "u": 0xF0000000,
    "e": -3,
    "f": 1.5,
    "d": -2.25,
    "t": True,
    "n": ["abc", "defg"],
    "w": 0x01020304,
    "deep": -300,
    "q": [7, 8, 9],
    "l": -123456,
    "bits": dict(
        zip(
            "abcdefghijkl",
            [1, 21, 5000, 4099, 0x98BADCFE12, -3000000000, -2, 99, 1, -200, True, -5],
            strict=True,
        )
    ),
    "m": [
        {"x": x, "p": dict(zip(NAMES, values, strict=True)), "y": y, "z": z}
        for x, values, y, z in (
            (
                200,
                [5, 100000, -777, 0x3EDCBA9876543210, -2, 60000, 250, 0xDEADBEEF, 0.125, -60000000000],
                9,
                2,
            ),
            (100, [2, 131071, 1023, 1, 0x7FFFFFFFFFFFFFFF, 1, 2, 3, -0.5, 68719476735], 15, 3),
        )
    ],
}
COMPILERS = [
    *("gcc", "gcc -m32", "gcc -mx32", "powerpc-linux-gnu-gcc", "powerpc-linux-gnu-gcc -m64"),
    *("clang", "clang -m32"),
    *(
        f"clang --target={machine}"
        for machine in (
            *("armv7-none-eabi", "armeb-none-eabi", "aarch64", "mips", "riscv32", "riscv64", "s390x"),
            *("powerpc", "m68k"),
        )
    ),
]


@pytest.mark.each(3)
@pytest.mark.parametrize("version", [2, 4, 5])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_what_was_written_is_read(compiler, version, tmp_path):
    from elftools.elf.elffile import ELFFile

    source, made = tmp_path / "a.c", tmp_path / "a.o"
    source.write_text(SOURCE)
    command, *flags = compiler.split()
    if shutil.which(command) is None:
        pytest.skip(f"needs {command}")
    done = subprocess.run(
        [command, *flags, "-w", "-g", f"-gdwarf-{version}", "-ffreestanding", "-c", source, "-o", made],
        capture_output=True,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"{compiler} makes no code here")
    layout, _ = DebugInfo(made).layout(["Top"], {}, "x")
    layout = parse_layout(dumps(layout).encode(), "again")
    structs = Structs([replace(layout, bindings={Key(0x0890): "Top"})])
    bound = structs.all[0]
    data = ELFFile(BytesIO(made.read_bytes())).get_section_by_name(".values").data()[: bound.size]
    assert bound.fits(len(data))
    values = structs.types.decode(bound.type, bound.encode_one(data, (0, 0, 0, 0, 0)))
    assert {name: values[name] for name in VALUES} == VALUES
