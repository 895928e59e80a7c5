"""Debug information that is unusual, halved, or damaged: read for what it is, or one line is said."""

import random
import shutil
import subprocess
from io import BytesIO

import pytest
from effort import LONG, examples

from edoras_tools.addons.debug_info.dwarf import DebugInfo
from edoras_tools.addons.debug_info.writing import take
from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import dumps, parse_layout

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")

NESTED = """
typedef struct { int n; struct { short a[0]; struct { char t[3]; } in[2]; } p; float f[][2]; } Hk_t;
Hk_t hk;
"""


def compiled(folder, text, *flags, name="made.o", compiler="gcc"):
    """Compile a source, and skip where this machine cannot."""
    source = folder / ("a.cc" if compiler == "g++" else "a.c")
    source.write_text(text)
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    done = subprocess.run(
        [compiler, "-w", "-g", *flags, "-c", source, "-o", folder / name],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"{compiler}: {done.stderr.splitlines()[0]}")
    return folder / name


def members(layout, name):
    return [(item.name, str(item.type), item.offset, item.dims) for item in layout.structs[name].members]


def written(path, *names):
    """Return the layout of some structs, after it was written and read again."""
    layout = take(DebugInfo(path), names, {}, None).layout
    again = parse_layout(dumps(layout).encode(), "again")
    assert (again.structs, again.enums) == (layout.structs, layout.enums)
    return again


def test_an_array_without_a_size_is_nothing_but_at_the_end(tmp_path):
    text = """
    typedef struct { int none[0]; char c; int rows[2][0]; int last[]; } A;
    typedef struct { int n; A a; } B;
    typedef struct { int rows[2][0]; } C;
    A *a; B *b; C c;
    """
    layout = written(compiled(tmp_path, text), "A", "B", "C")
    assert members(layout, "A") == [("c", "char", 0, ()), ("last", "int32", 4, (0,))]
    assert members(layout, "C") == []


def test_names_that_only_the_compiler_takes(tmp_path):
    text = "typedef struct { int $d; int \u00e9t\u00e9; int _d; struct { int null; } no; } null; null n;"
    layout = written(compiled(tmp_path, text), "null")
    assert [item[0] for item in members(layout, "null")] == ["_d", "_t_", "_d2", "no"]


def test_classes(tmp_path):
    text = """
    template<class T> struct Tp { T v[2]; };
    struct Base { int x; static int shared; };
    struct Derived : Base { short x; Tp<Tp<char>> t; int Base::*p; };
    struct Virtual : virtual Base { int w; };
    Derived d; Virtual v;
    """
    made = compiled(tmp_path, text, "-gdwarf-4", compiler="g++")
    layout = written(made, "Derived")
    assert members(layout, "Derived")[:3] == [
        ("x", "int32", 0, ()),
        ("x2", "int16", 4, ()),
        ("t", "Tp_Tp_char___", 6, ()),
    ]
    assert members(written(made, "Tp<Tp<char> >"), "Tp_Tp_char___") == [("v", "Tp_char_", 0, (2,))]
    with pytest.raises(ConfigError, match=r"made\.o: .*the place of a virtual base class is computed"):
        take(DebugInfo(made), ["Virtual"], {}, None)


def test_numbers_that_ros_has_not_are_bytes(tmp_path):
    text = """
    typedef struct __attribute__((scalar_storage_order("big-endian"))) { int a; short b[2]; char c; } Turned;
    typedef struct { __int128 wide:100; __int128 rest:9; } Wide;
    Turned t; Wide w;
    """
    layout = written(compiled(tmp_path, text), "Turned", "Wide")
    assert members(layout, "Turned") == [
        ("a", "byte", 0, (4,)),
        ("b", "byte", 4, (2, 2)),
        ("c", "char", 8, ()),
    ]
    assert members(layout, "Wide") == [("wide", "byte", 0, (13,)), ("rest", "byte", 12, (2,))]


@pytest.mark.parametrize(("flag", "kind"), [("-fsigned-char", "int8"), ("-funsigned-char", "uint8")])
def test_a_bit_field_of_char_is_a_number(flag, kind, tmp_path):
    layout = written(compiled(tmp_path, "struct A { char text; char low:3; char high:5; } a;", flag), "A")
    assert members(layout, "A") == [("text", "char", 0, ()), ("low", kind, 1, ()), ("high", kind, 1, ())]


def test_a_struct_that_no_packet_holds(tmp_path):
    made = compiled(tmp_path, "struct A { char text[1 << 20]; }; struct B { struct A a[40]; } b;")
    with pytest.raises(ConfigError, match=r"made\.o: B: 41943040 bytes are more than any packet holds"):
        take(DebugInfo(made), ["B"], {}, None)


def test_structs_within_one_without_a_name_are_called_after_the_outermost(tmp_path):
    layout = written(compiled(tmp_path, NESTED), "Hk")
    assert list(layout.structs) == ["Hk_p_in", "Hk_p", "Hk_t"]


def test_two_structs_of_one_name(tmp_path):
    one = compiled(tmp_path, "struct X { int a; } x1; struct Same { int s; } s1;", name="one.o")
    text = "struct X { char b[3]; } x2; struct Same { int s; } s2; struct Y { struct X x; } y; int main(){}"
    other = compiled(tmp_path, text, name="other.o")
    both = tmp_path / "both"
    subprocess.run(["gcc", one, other, "-o", both], check=True)
    info = DebugInfo(both)
    taken = take(info, ["Y", "X", "Same"], {}, None)
    assert {name: item.size for name, item in taken.layout.structs.items()} == {
        "X": 3,
        "Y": 3,
        "X_2": 4,
        "Same": 4,
    }
    assert list(taken.types) == ["Y", "X_2", "Same"]
    one, two = info.warnings
    assert one.startswith("X is declared in more than one way; the first is taken, of 4 bytes: check it")
    assert two == "X is declared in more than one way; the other is called X_2"


def test_a_struct_called_as_an_enumeration_or_as_a_type_of_ours(tmp_path):
    one = compiled(tmp_path, "enum X { A } e; struct Y { enum X x; } y;", name="one.o")
    text = "struct X { int a; }; typedef struct { struct X x; } byte; byte b; int main(){}"
    other, both = compiled(tmp_path, text, name="other.o"), tmp_path / "both"
    subprocess.run(["gcc", one, other, "-o", both], check=True)
    layout = written(both, "Y", "byte")
    assert [*layout.enums, *layout.structs] == ["X", "Y", "X_2", "byte_2"]


@pytest.mark.parametrize(
    ("flags", "name", "said"),
    [
        (["-gsplit-dwarf"], "made.o", r"is in .*made\.dwo; compile it without -gsplit-dwarf"),
        (["-gsplit-dwarf"], "made.dwo", "one half of split debug information; compile it without"),
        (["-flto", "-fno-fat-lto-objects"], "made.o", "compile it without -flto, or give the program"),
        (["-gz=zlib-gnu"], "made.o", "compressed in an old way; compile it with -gz=zlib or no -gz"),
        (["-fdebug-types-section"], "made.o", "compile it without -fdebug-types-section"),
        (["-g0"], "made.o", "stripped or compiled without -g; compile it with -g"),
    ],
)
def test_what_to_compile_otherwise_is_said(tmp_path, flags, name, said):
    compiled(tmp_path, NESTED, *flags)
    with pytest.raises(ConfigError, match=rf"^{tmp_path / name}: .*{said}") as error:
        DebugInfo(tmp_path / name)
    assert "\n" not in str(error.value)


def test_entries_in_a_circle(tmp_path):
    from elftools.elf.elffile import ELFFile

    made = compiled(tmp_path, NESTED)
    data = bytearray(made.read_bytes())
    elf = ELFFile(BytesIO(bytes(data)))
    place = elf.get_section_by_name(".debug_info")["sh_offset"]
    siblings = [
        place + item.attributes["DW_AT_sibling"].offset
        for unit in elf.get_dwarf_info().iter_CUs()
        for item in unit.iter_DIEs()
        if "DW_AT_sibling" in item.attributes
    ]
    assert siblings
    for at in siblings:
        broken = tmp_path / "broken.o"
        broken.write_bytes(data[:at] + bytes(4) + data[at + 4 :])
        with pytest.raises(ConfigError, match="cannot be read: its entries go in a circle"):
            take(DebugInfo(broken), ["Hk"], {}, None)


@pytest.mark.quick("flags1")
@pytest.mark.parametrize("flags", [["-gdwarf-2"], ["-gdwarf-5"], ["-gz=zlib"]])
def test_of_damaged_files_one_line_is_said(flags, tmp_path):
    """Cut short, or with bits turned over: it is read, or the file is named and what is wrong with it."""
    data = compiled(tmp_path, NESTED, *flags).read_bytes()
    chance, broken = random.Random(7), tmp_path / "broken.o"
    said = set()
    for _ in range(examples(200, 16)):
        harmed = bytearray(data)
        if chance.random() < 0.2:
            harmed = harmed[: chance.randrange(4, len(data))]
        for _ in range(chance.choice([1, 3, 40])):
            harmed[chance.randrange(4, len(harmed))] ^= 1 << chance.randrange(8)
        broken.write_bytes(harmed)
        said.add(mistake_of(broken))
    assert len(said) > (5 if LONG else 3)  # what is harmed is also the name of the folder, of any length
    assert all(text.startswith(str(broken)) and "\n" not in text for text in said - {""}), said


def mistake_of(path):
    """Return what is said of a file; nothing where all its structs can be read, written and read again."""
    try:
        info = DebugInfo(path)
        written(path, *(item.name for item in info.list()))
    except ConfigError as error:
        return str(error)
    return ""
