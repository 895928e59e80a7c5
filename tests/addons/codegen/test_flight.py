"""Four flight apps in the style of the public ones, given spoilt commands: zeros or the truth."""

from __future__ import annotations

import random
import struct
import subprocess
from dataclasses import dataclass

import numpy as np
import pytest
from effort import examples

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.errors import WireError
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

STORE = TypeStore()
TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose"
STAMPED, JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"
COMMANDS = examples(25_000, part=40)
"""To each app."""
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror")
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@dataclass(frozen=True)
class App:
    """An app: its source, its types (the first is that of its commands), what else its compiler is told."""

    source: str
    types: tuple[str, ...]
    defined: tuple[str, ...] = ()

    @property
    def room(self):
        """Bytes that a relay gives away; 0 for an app that commands a robot itself."""
        return next((int(word[7:]) for word in self.defined if word.startswith("-DROOM=")), 0)


def relay(name, room):
    package, _, short = name.split("/")
    return App("relay", (name,), (f'-DPACKAGE="{package}"', f'-DTYPE="{short}"', f"-DROOM={room}"))


APPS = {
    "rover": App("rover", (TWIST, STAMPED)),
    "arm": App("arm", (POSE, JOINTS)),
    "two rovers": relay(STAMPED, 400),
    "two arms": relay(JOINTS, 8000),
}


def commands(name):
    """Yield packets of a type: one in eight whole, the others cut, longer, or with other bytes."""
    dice = random.Random(name)
    whole = []
    for number in range(64):
        values = arbitrary(STORE, name, random.Random(number))
        cdr = STORE.encode(name, values, big_endian=number % 4 == 0)
        body = struct.pack("<QQ", len(cdr), len(cdr)) + cdr + bytes(number % 16)
        whole.append(struct.pack(">HHHBB", 0x1827, 0, len(body) + 1, 1, 0) + body)
    for number in range(COMMANDS):
        packet = bytearray(dice.choice(whole))
        how = number % 8
        if how in {1, 2}:
            packet = packet[: dice.randrange(8, len(packet))]
            packet[4:6] = (len(packet) - 7).to_bytes(2, "big")
        elif how == 3:
            packet[4:6] = dice.randrange(1, 1200).to_bytes(2, "big")
        elif how == 4:
            struct.pack_into("<Q", packet, 8, dice.choice([0, 3, 4, len(packet), 2**32, 2**64 - 1]))
        elif how:
            for _ in range(dice.randrange(1, 5)):
                packet[dice.randrange(4, len(packet))] = dice.choice([0, 1, 0x7F, 0xFF, dice.randrange(256)])
        yield bytes(packet)


def truth(name, packet):
    """The values of a command on cFE's bus, as its header says, and their CDR; None where it is none."""
    size = int.from_bytes(packet[4:6], "big") + 7
    packet = packet[:size].ljust(size, b"\xa5")
    if size < 24 or (length := int.from_bytes(packet[8:16], "little")) > size - 24:
        return None
    cdr = packet[24 : 24 + length]
    try:
        values = STORE.decode(name, cdr)
    except WireError:
        return None
    if not fits(values) or length - STORE.extent(name, cdr) > STORE.most_trailing(name):
        return None
    return values, STORE.encode(name, values)


def fits(value):
    """Whether all sequences and strings are within the usual bounds."""
    if isinstance(value, dict):
        return all(map(fits, value.values()))
    if isinstance(value, str):
        return len(value.encode("utf-8", "surrogateescape")) <= 64
    if hasattr(value, "__len__"):
        return len(value) <= 32 and all(map(fits, value))
    return True


def same(app, told, output):
    """Whether an app gave away just what it was told; None are zeros."""
    if told is None:
        return not any(output)
    values, cdr = told
    if not app.room:
        expected = [number for part in values.values() for number in part.values()]
        return np.array_equal(np.frombuffer(output, "<f8"), expected, equal_nan=True)
    whole = struct.pack("<QQ", len(cdr), len(cdr)) + cdr
    if output == whole.ljust(app.room, b"\0"):
        return True
    given = output[16 : len(whole)]  # a NaN may have become another one in a register of the processor
    return not any(output[len(whole) :]) and str(STORE.decode(app.types[0], given)) == str(values)


def records(data):
    place = 0
    while place < len(data):
        (size,) = struct.unpack_from("<I", data, place)
        yield data[place + 4 : place + 4 + size]
        place += 4 + size


@pytest.fixture(scope="module", params=APPS)
def flown(request, tools, tmp_path_factory):
    """An app, a folder with its library, its commands in a file, and what each of them says."""
    app, folder = APPS[request.param], tmp_path_factory.mktemp("flown")
    write_folder(folder, generate(STORE, LibraryOrder(app.types)).files)
    given = list(commands(app.types[0]))
    (folder / "commands").write_bytes(b"".join(struct.pack("<I", len(item)) + item for item in given))
    return app, folder, [truth(app.types[0], item) for item in given]


@pytest.mark.each(2)
@pytest.mark.quick("rover-64 bits", "arm-32 bits")
@pytest.mark.parametrize("flags", [SANITIZED, ("-m32",)], ids=["64 bits", "32 bits"])
def test_spoilt_commands(flown, cc, tools, tmp_path, flags):
    app, folder, truths = flown
    if "-m32" in flags:
        tools.need_32_bits(cc, tmp_path, flags)
    sources = [tools.HERE / "c" / f"{name}.c" for name in ("fly", app.source, "cfe")]
    program = cc(
        *(tmp_path / "fly", f"-I{folder}", f"-I{tools.HERE / 'c'}", *app.defined, *sources),
        *sorted(folder.glob("*.c")),
        flags=(*FLAGS, *flags),
    )
    out = tmp_path / "outputs"
    done = subprocess.run(
        [*tools.steady(), program, folder / "commands", out],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={"ASAN_OPTIONS": "detect_leaks=0"},
    )
    assert done.returncode == 0, done.stderr[:4000]
    outputs = list(records(out.read_bytes()))
    assert len(outputs) == len(truths) == COMMANDS
    assert all(len(item) in {48, 56, app.room} for item in outputs)
    wrong = [number for number, pair in enumerate(zip(truths, outputs, strict=True)) if not same(app, *pair)]
    assert not wrong
    assert COMMANDS // 25 < sum(item is not None for item in truths) < COMMANDS * 4 // 5
