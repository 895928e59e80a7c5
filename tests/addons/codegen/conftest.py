"""Generated C, compiled once, and driven through ctypes."""

from __future__ import annotations

import ctypes
import shutil
import struct
import subprocess
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest
from effort import LONG
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.plan import BoundRule, Bounds
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import PRIMITIVES, Shape

HERE = Path(__file__).parent
PACKAGES = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Wcast-qual", "-Werror")
STRINGS, SEQUENCES = 24, 5
CUSTOM = {
    "probe_msgs/msg/Inner": "uint8 a\nfloat64 b\nuint8 c\nstring text 'inner'\n",
    "probe_msgs/msg/All": "".join(
        f"{name} one_{short}\n{name}[3] three_{short}\n{name}[] many_{short}\n{name}[<=2] few_{short}\n"
        for name in (*PRIMITIVES, "string", "Inner", "std_msgs/Empty")
        for short in [name.rpartition("/")[2].lower()]
    ),
    "probe_msgs/msg/Bounds": "uint8 a\nstring<=4 word\nint32[<=3] few\nstring<=2[<=2] words\nfloat64 end\n",
    "probe_msgs/msg/Wide": "uint8 before\nwstring text\nwstring[] more\nwstring<=3 short\nfloat64 after\n",
    "probe_msgs/msg/Deep": "All[<=1] all\nBounds[2] bounds\nnav_msgs/Path[] paths\nint64 last\n",
    "probe_msgs/msg/Words": "int32 default\nbool class\nstring int\nInner[] switch\n",
    "probe_msgs/msg/Defaults": (
        "int8 a -128\nint16 b -7\nint32 c -2147483648\n"
        "int64 d -9223372036854775808\nuint64 e 18446744073709551615\n"
        "float32 f 0.1\nfloat64 g -1e-300\nbool h true\nchar i 65\nbyte j 255\n"
        "string s 'it\\'s \"??/\" \\\\ é€'\nwstring w 'é€𝄞'\n"
        "float64[] numbers [1.5, -2]\nbool[2] flags [true, false]\nstring[] names ['a', 'bc']\n"
        "wstring[2] wide ['a', 'é']\ngeometry_msgs/Quaternion[2] q\nInner inner\nint32[] none []\n"
        "int32 LOW=-2147483648\nint64 LOWEST=-9223372036854775808\nuint64 HIGH=18446744073709551615\n"
        'float32 HALF=0.5\nfloat64 TINY=-1e-300\nstring TEXT="x ??= y"\nbool YES=true\nuint8 MAX_CDR=3\n'
    ),
}


class TypeInfo(ctypes.Structure):
    _fields_ = (
        ("message_namespace_", ctypes.c_char_p),
        ("message_name_", ctypes.c_char_p),
        ("member_count_", ctypes.c_uint32),
        ("size_of_", ctypes.c_size_t),
        ("buffer_size", ctypes.c_size_t),
    )


class Library:
    """A compiled library.

    Attributes:
        dll: all of its functions.
    """

    OK, ARGUMENT, ENCAPSULATION, TRUNCATED, TRAILING, UNTERMINATED, BOUND, NO_SPACE = range(8)
    C_TYPES: ClassVar = {
        "bool": ctypes.c_bool,
        "byte": ctypes.c_uint8,
        "char": ctypes.c_uint8,
        "float32": ctypes.c_float,
        "float64": ctypes.c_double,
        **{f"{u}int{n}": getattr(ctypes, f"c_{u}int{n}") for u in ("", "u") for n in (8, 16, 32, 64)},
    }

    def __init__(self, path):
        self.dll = ctypes.CDLL(str(path))
        pointer, size = ctypes.c_void_p, ctypes.c_size_t
        self.dll.get_type_info.restype = ctypes.POINTER(TypeInfo)
        for name in ("get_type_support", "get_type_support_library"):
            getattr(self.dll, name).restype = pointer
        for name in ("create_msg", "from_uint_buffer_to_msg_pointer", "from_msg_pointer_to_uint_buffer"):
            getattr(self.dll, name).restype = pointer
        self.dll.create_msg.argtypes = [pointer]
        self.dll.from_uint_buffer_to_msg_pointer.argtypes = [ctypes.c_char_p, size, pointer, pointer, pointer]
        self.dll.from_uint_buffer_to_msg_pointer_into.argtypes = [
            *(ctypes.c_char_p, size, size, pointer, pointer, pointer, size)
        ]
        self.dll.from_msg_pointer_to_uint_buffer.argtypes = [pointer] * 4
        self.dll.from_msg_pointer_to_uint_buffer_into.argtypes = [*[pointer] * 4, size, pointer]
        self.dll.resize_sequence.argtypes = [pointer, pointer, ctypes.c_char_p, size]
        self.dll.resize_sequence.restype = ctypes.c_bool
        for name, kind in (*self.C_TYPES.items(), ("const_char", ctypes.c_char_p), ("const_char16", pointer)):
            setter, getter = getattr(self.dll, f"set_{name}"), getattr(self.dll, f"get_{name}")
            setter.argtypes = [pointer, pointer, ctypes.c_char_p, kind]
            getter.argtypes = [pointer, pointer, ctypes.c_char_p, pointer]
            setter.restype = getter.restype = ctypes.c_bool
        self.dll.get_sequence_size.argtypes = [pointer, pointer, ctypes.c_char_p, pointer]
        self.dll.get_sequence_size.restype = ctypes.c_bool
        self.dll.edoras_status_text.restype = ctypes.c_char_p

    @cache  # noqa: B019  as many as there are types
    def info(self, name):
        package, _, short = name.split("/")
        return self.dll.get_type_info(package.encode(), short.encode())

    def message(self, name):
        """A message whose bytes are all 0xA5."""
        size = self.info(name).contents.size_of_
        message = (ctypes.c_uint64 * (size // 8 + 1))()
        ctypes.memset(message, 0xA5, size)
        return message

    def decode(self, name, cdr):
        """The status and the message."""
        message = self.message(name)
        cdr = bytes(cdr)
        function = getattr(self.dll, name.replace("/", "__") + "__decode")
        return function(message, cdr, ctypes.c_size_t(len(cdr))), message

    def encode(self, name, message, room=None):
        """The status and the bytes."""
        room = self.info(name).contents.buffer_size if room is None else room
        buffer = ctypes.create_string_buffer(b"\xa5" * (room + 8), room + 8)
        length = ctypes.c_size_t(77)
        function = getattr(self.dll, name.replace("/", "__") + "__encode")
        message = ctypes.c_void_p(message) if isinstance(message, int) else message
        status = function(message, buffer, ctypes.c_size_t(room), ctypes.byref(length))
        assert buffer.raw[room:] == b"\xa5" * 8
        assert (length.value == 0) == (status != self.OK)
        return status, buffer.raw[: length.value]

    def created(self, name):
        message = self.dll.create_msg(self.info(name))
        assert message
        return message

    def get(self, message, name, path, kind):
        """The value at a path, by the get_ function of a kind; None where it says false."""
        if kind == "string":
            text = ctypes.create_string_buffer(b"\xa5" * 100, 100)
            found = self.dll.get_const_char(message, self.info(name), path.encode(), text)
            return text.value.decode("utf-8", "replace") if found else None
        if kind == "wstring":
            units = (ctypes.c_uint16 * 100)()
            found = self.dll.get_const_char16(message, self.info(name), path.encode(), units)
            data = bytes(units)[: 2 * list(units).index(0)]
            return data.decode("utf-16-le", "surrogatepass") if found else None
        value = self.C_TYPES[kind]()
        found = getattr(self.dll, f"get_{kind}")(message, self.info(name), path.encode(), ctypes.byref(value))
        return value.value if found else None

    def set(self, message, name, path, kind, value):
        """Whether the set_ function of a kind took a value."""
        if kind == "string":
            return self.dll.set_const_char(message, self.info(name), path.encode(), value.encode())
        if kind == "wstring":
            data = value.encode("utf-16-le", "surrogatepass") + b"\0\0"
            units = (ctypes.c_uint16 * (len(data) // 2)).from_buffer_copy(data)
            return self.dll.set_const_char16(message, self.info(name), path.encode(), units)
        return getattr(self.dll, f"set_{kind}")(message, self.info(name), path.encode(), value)

    def count(self, message, name, path):
        size = ctypes.c_size_t()
        found = self.dll.get_sequence_size(message, self.info(name), path.encode(), ctypes.byref(size))
        return size.value if found else None


@pytest.fixture(scope="session")
def store():
    return TypeStore(definitions=CUSTOM)


@pytest.fixture(scope="session")
def rosbags_store(store):
    types = get_typestore(Stores.ROS2_JAZZY)
    for name in CUSTOM:
        if name.rpartition("/")[2] not in {"Wide", "Defaults"}:
            types.register(
                {
                    key: value
                    for key, value in get_types_from_msg(store.definition(name), name).items()
                    if key not in types.fielddefs
                }
            )
    return types


@pytest.fixture(scope="session")
def cc():
    """A function: compile C; the result is the file that comes out."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    assert compiler, "a C compiler is needed: apt install gcc"

    def run(out, *arguments, flags=FLAGS):
        command = [compiler, "-O1" if LONG else "-O0", *flags, *map(str, arguments), "-o", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
        assert done.returncode == 0, done.stderr[:4000]
        return out

    return run


@pytest.fixture(scope="session")
def generated(store, tmp_path_factory):
    """The folder of a library of the five packages and of the custom messages."""
    folder = tmp_path_factory.mktemp("library")
    rules = ("probe_msgs/Inner.text=9", "nav_msgs/Path.poses=2", "probe_msgs/Wide.more[]=4")
    bounds = Bounds(STRINGS, SEQUENCES, tuple(map(BoundRule.read, rules)))
    write_folder(folder, generate(store, LibraryOrder((*PACKAGES, "probe_msgs"), bounds)).files)
    return folder


@pytest.fixture(scope="session")
def library(generated, cc):
    out = generated / "libedoras.so"
    return Library(cc(out, "-shared", "-fPIC", f"-I{generated}", *sorted(generated.glob("*.c"))))


@pytest.fixture(scope="session")
def corpus(store, tmp_path_factory):
    """A file of messages for judge.c, one of every type but those that nest too much, the same every time."""
    import random

    from edoras_tools.pipelines.sending.inject import arbitrary

    path = tmp_path_factory.mktemp("corpus") / "messages"
    records = []
    for name in TYPES:
        dice = random.Random(name)
        for cdr in (store.encode(name, arbitrary(store, name, dice)) for _ in range(40)):
            if _fits(store, name, store.decode(name, cdr)):
                package, _, short = name.split("/")
                head = f"{package}\0{short}\0".encode() + struct.pack("<I", len(cdr))
                records.append(head + cdr)
                break
    path.write_bytes(b"".join(records))
    assert len(records) > 90
    return path


def _fits(store, name, values):
    """Whether no sequence is longer than the bounds of the library."""
    for field in store.fields(name):
        value = values[field.name]
        most = 2 if name.endswith("/Path") else SEQUENCES
        if field.shape is Shape.SEQUENCE and len(value) > most:
            return False
        if name.endswith("/Inner") and field.name == "text" and len(value) > 9:
            return False
        if name.endswith("/Wide") and field.name == "more" and max(map(len, value)) > 4:
            return False
        items = value if field.shape is not Shape.SCALAR else [value]
        if "/" in field.type and not all(_fits(store, field.type, item) for item in items):
            return False
    return True


TYPES = sorted(
    [name for name in get_typestore(Stores.ROS2_JAZZY).fielddefs if name.split("/")[0] in PACKAGES]
) + sorted(CUSTOM)


def _numbers(kind):
    code = PRIMITIVES[kind]
    size = struct.calcsize(code)
    if kind == "bool":
        return st.booleans()
    if kind.startswith("float"):
        return st.floats(width=size * 8, allow_nan=kind == "float64")  # ctypes makes a float a double
    low, high = (0, 2 ** (8 * size)) if code.isupper() else (-(2 ** (8 * size - 1)), 2 ** (8 * size - 1))
    return st.integers(low, high - 1)


def _texts(most, *, wide):
    unit = "utf-16-le" if wide else "utf-8"
    characters = st.characters(codec="utf-8", exclude_characters="\0")
    return st.text(characters, max_size=most).filter(
        lambda text: len(text.encode(unit)) <= most * (2 if wide else 1)
    )


def messages(store, name):
    """Values of a type within the bounds of the library."""
    fields = {}
    for field in store.fields(name):
        most = field.string_bound or {("Inner", "text"): 9, ("Wide", "more"): 4}.get(
            (name.rpartition("/")[2], field.name), STRINGS
        )
        if field.type in PRIMITIVES:
            one = _numbers(field.type)
        elif field.type in {"string", "wstring"}:
            one = _texts(most, wide=field.type == "wstring")
        else:
            one = messages(store, field.type)
        count = 2 if field.name in {"poses", "paths"} else min(field.size or SEQUENCES, SEQUENCES)
        if field.shape is Shape.SEQUENCE:
            one = st.lists(one, max_size=count)
        elif field.shape is Shape.ARRAY and field.size > 8:
            one = st.tuples(one, one).map(lambda pair, size=field.size: [pair[0], *[pair[1]] * (size - 1)])
        elif field.shape is Shape.ARRAY:
            one = st.lists(one, min_size=field.size, max_size=field.size)
        fields[field.name] = one
    return st.fixed_dictionaries(fields)


def leaves(store, name, values, prefix=""):
    """Every single value of a message as (path, kind, value), and every sequence as (path, None, count)."""
    for field in store.fields(name):
        path, value = prefix + field.name, values[field.name]
        many = field.shape is not Shape.SCALAR
        if field.shape is Shape.SEQUENCE:
            yield path, None, len(value)
        for place, item in (
            ((f"{path}.{index}", item) for index, item in enumerate(value)) if many else ((path, value),)
        ):
            if "/" in field.type:
                yield from leaves(store, field.type, item, f"{place}.")
            else:
                yield place, field.type, item


def steady():
    """What makes a program lie at the same addresses every time: old sanitizers mind some of them."""
    setarch = shutil.which("setarch")
    works = (
        setarch and subprocess.run([setarch, "-R", "true"], capture_output=True, check=False).returncode == 0
    )
    return [setarch, "-R"] if works else []


def need_32_bits(cc, folder, flags=("-m32",)):
    """Skip a test where the compiler makes no 32-bit programs with some flags."""
    probe = folder / "probe.c"
    probe.write_text("#include <stdlib.h>\nint main(void) { return (int)sizeof(size_t) - 4; }\n")
    try:
        cc(folder / "probe", probe, flags=flags)
    except AssertionError:
        pytest.skip("this compiler makes no such 32-bit programs: apt install gcc-multilib")


@pytest.fixture(scope="session")
def tools():
    return SimpleNamespace(
        steady=steady,
        need_32_bits=need_32_bits,
        messages=messages,
        leaves=leaves,
        TYPES=TYPES,
        PACKAGES=PACKAGES,
        Library=Library,
        HERE=HERE,
        FLAGS=FLAGS,
    )
