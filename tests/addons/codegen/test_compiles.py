"""The generated C under every compiler's eye that is here: warnings, sanitizers, 32 bits, C++."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from places import ROOT

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.ros import TypeStore

SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize=bool", "-fno-sanitize-recover=all")
"""judge.c spoils messages, flags among them: those that are neither true nor false are its own doing."""
TIMES = 60


def build(cc, tools, generated, out, *flags):
    """The judge with the library."""
    return cc(out, f"-I{generated}", tools.HERE / "c/judge.c", *sorted(generated.glob("*.c")), flags=flags)


def judged(program, corpus, times, **environment):
    done = subprocess.run(
        [*program, corpus, str(times)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[:4000]
    return dict(line.rsplit(": ", 1) for line in done.stdout.splitlines())


@pytest.mark.long
def test_spoilt_messages_under_sanitizers(cc, tools, generated, corpus, tmp_path):
    program = build(cc, tools, generated, tmp_path / "judge", *tools.FLAGS, *SANITIZERS)
    statuses = judged([*tools.steady(), program], corpus, TIMES, ASAN_OPTIONS="detect_leaks=0")
    assert int(statuses["ok"]) > 500
    assert int(statuses["a field lies outside the given bytes"]) > 500
    assert int(statuses["a sequence or string is longer than its bound"]) > 100
    assert int(statuses["a string does not end in NUL"]) > 50
    assert int(statuses["the representation is not CDR"]) > 50


@pytest.mark.long
def test_32_bits(cc, tools, generated, corpus, tmp_path):
    """The same bytes where size_t has 4 and double is aligned to 4."""
    tools.need_32_bits(cc, tmp_path)
    program = build(cc, tools, generated, tmp_path / "judge", *tools.FLAGS, "-m32")
    assert int(judged([program], corpus, 5)["ok"]) > 0


def test_a_big_endian_processor(tools, generated, corpus, tmp_path):
    """The same bytes on a 32-bit PowerPC, emulated."""
    compiler, emulator = shutil.which("powerpc-linux-gnu-gcc"), shutil.which("qemu-ppc")
    if compiler is None or emulator is None:
        pytest.skip(
            "no emulated PowerPC: apt install gcc-powerpc-linux-gnu libc6-dev-powerpc-cross qemu-user"
        )
    sources = [tools.HERE / "c/judge.c", *sorted(generated.glob("*.c"))]
    command = [compiler, "-O1", "-static", *tools.FLAGS, f"-I{generated}", *sources, "-o", tmp_path / "judge"]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    judged([emulator, tmp_path / "judge"], corpus, 5)


def test_other_compilers(tools, generated, tmp_path):
    compiler = shutil.which("clang")
    if compiler is None:
        pytest.skip("clang is not installed")
    for path in sorted(generated.glob("*.c")):
        done = subprocess.run(
            [compiler, *tools.FLAGS, f"-I{generated}", "-fsyntax-only", path],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[:4000]


def test_headers_alone_and_in_cpp(tools, generated):
    """Each header includes what it needs, and may stand in C++."""
    for compiler, standard, language in (("cc", "c99", "c"), ("c++", "c++11", "c++")):
        if shutil.which(compiler) is None:
            continue
        command = [
            compiler,
            f"-std={standard}",
            "-Wall",
            "-Wextra",
            "-Wpedantic",
            "-Werror",
            f"-I{generated}",
        ]
        for path in sorted(generated.rglob("*.h")):
            done = subprocess.run(
                [*command, "-x", language, "-fsyntax-only", "-"],
                input=f'#include "{path.relative_to(generated)}"\nextern int nothing;\n',
                capture_output=True,
                text=True,
                check=False,
                timeout=300,
            )
            assert done.returncode == 0, done.stderr[:4000]


def test_constants(cc, generated, tmp_path):
    source = tmp_path / "constants.c"
    source.write_text(
        """\
#include "edoras_core/messages.h"
int32_t low(void) { return probe_msgs__msg__Defaults__LOW; }
int64_t lowest(void) { return probe_msgs__msg__Defaults__LOWEST; }
uint64_t high(void) { return probe_msgs__msg__Defaults__HIGH; }
double half(void) { return (double)probe_msgs__msg__Defaults__HALF; }
double tiny(void) { return probe_msgs__msg__Defaults__TINY; }
const char *text(void) { return probe_msgs__msg__Defaults__TEXT; }
bool yes(void) { return probe_msgs__msg__Defaults__YES; }
int8_t status(void) { return sensor_msgs__msg__NavSatStatus__STATUS_NO_FIX; }
uint8_t renamed(void) { return probe_msgs__msg__Defaults__MAX_CDR_; }
"""
    )
    flags = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror", "-shared", "-fPIC")
    made = ctypes.CDLL(str(cc(tmp_path / "constants.so", source, f"-I{generated}", flags=flags)))
    for name, kind, value in (
        ("low", ctypes.c_int32, -(2**31)),
        ("lowest", ctypes.c_int64, -(2**63)),
        ("high", ctypes.c_uint64, 2**64 - 1),
        ("half", ctypes.c_double, 0.5),
        ("tiny", ctypes.c_double, -1e-300),
        ("text", ctypes.c_char_p, b"x ??= y"),
        ("yes", ctypes.c_bool, True),
        ("status", ctypes.c_int8, -1),
        ("renamed", ctypes.c_uint8, 3),
    ):
        function = getattr(made, name)
        function.restype = kind
        assert function() == value, name


def test_the_example_of_the_page(cc, tmp_path):
    page = (ROOT / "docs/codegen.md").read_text()
    include, _, code = re.search(r"```c\n(.*?)```", page, re.DOTALL)[1].partition("\n")
    write_folder(tmp_path, generate(TypeStore(), LibraryOrder(("sensor_msgs/JointState",))).files)
    source = tmp_path / "example.c"
    source.write_text(f"{include}\nvoid example(void);\nvoid example(void)\n{{\n{code}}}\n")
    cc(
        tmp_path / "example.so",
        source,
        f"-I{tmp_path}",
        flags=("-std=c99", "-Wall", "-Werror", "-shared", "-fPIC"),
    )


def test_no_heap_and_no_other_library(generated, library):
    """What the library needs of others: copying, filling and comparing memory and strings."""
    listed = subprocess.run(
        ["nm", "-D", "--undefined-only", generated / "libedoras.so"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    needed = {line.split()[-1].partition("@")[0] for line in listed.splitlines()}
    allowed = {"memcpy", "memset", "strcmp", "strncmp", "__stack_chk_fail"}
    assert {name for name in needed if not name.startswith(("_ITM", "__gmon", "__cxa"))} <= allowed


def test_no_recursion_no_goto_no_heap_in_the_text(generated):
    for path in [*generated.glob("*.c"), *Path(generated).rglob("*.h")]:
        text = path.read_text()
        for word in ("goto ", "malloc(", "alloca(", "printf(", "long ", "short "):
            assert word not in text.replace("as long as", "").replace("no longer", ""), (path.name, word)
