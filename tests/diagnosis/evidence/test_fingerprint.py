"""Fingerprints of values: the same for the same values, whatever type of element holds them."""

import numpy as np
import pytest

from edoras_tools.diagnosis.evidence.fingerprint import of_values
from edoras_tools.ros import TypeStore

KINDS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
RANGES = {kind: np.iinfo(kind) for kind in KINDS}
LONG = 9000


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("types") / "own_msgs" / "msg"
    folder.mkdir(parents=True)
    for kind in KINDS:
        (folder / f"{kind.title()}.msg").write_text(f"{kind}[] data\nint32 last\n")
    (folder / "Texts.msg").write_text("string one\nstring[] more\n")
    return TypeStore(msg_paths=[folder.parents[1]])


def prints(store, kind, rows):
    return prints_of(store, f"own_msgs/msg/{kind.title()}", [{"data": row, "last": 7} for row in rows])


def prints_of(store, name, messages):
    cdrs = [store.encode(name, message) for message in messages]
    length = np.array([len(cdr) for cdr in cdrs], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    data = np.frombuffer(b"".join(cdrs) + bytes(64), np.uint8)
    return of_values(store, name, data, offset, length)[0].tolist()


ROWS = {
    "none": [],
    "small": [1, 2, 3],
    "octets": [0, 255, 7],
    "signed": [-1, 2, 3],
    "as unsigned they are the same bytes": [255, 2, 3],
    "wider": [1, 2, 256],
    "wider and signed": [-1, 200, 3],
    "another order": [2, 1, 3],
    "long": [index % 251 for index in range(LONG)],
    "long, and another at its end": [index % 251 for index in range(LONG - 1)] + [252],
    "long, and two blocks changed places": [index % 251 for index in range(4096, LONG)]
    + [index % 251 for index in range(4096)],
}


def test_the_same_values_have_the_same_fingerprint_in_every_type(store):
    found = {name: set() for name in ROWS}
    for kind in KINDS:
        fitting = {
            name: row
            for name, row in ROWS.items()
            if all(RANGES[kind].min <= item <= RANGES[kind].max for item in row)
        }
        for name, value in zip(fitting, prints(store, kind, fitting.values()), strict=True):
            found[name].add(value)
    assert {len(values) for values in found.values()} == {1}
    assert len(set.union(*found.values())) == len(ROWS)


def test_a_row_does_not_depend_on_those_beside_it(store):
    for kind in ("int8", "int16"):
        rows = [row for row in ROWS.values() if all(-128 <= item <= 127 for item in row)]
        assert prints(store, kind, rows) == [prints(store, kind, [row])[0] for row in rows]


def test_texts_stand_for_a_message_without_numbers(store):
    texts = [
        ("", []),
        ("a", []),
        ("", ["a"]),
        ("a", ["b", "c"]),
        ("a", ["c", "b"]),
        ("a", ["bc"]),
        ("\xe9", []),
    ]
    messages = [{"one": one, "more": more} for one, more in texts]
    found = prints_of(store, "own_msgs/msg/Texts", messages)
    assert found == prints_of(store, "own_msgs/msg/Texts", messages)
    assert len(set(found)) == len(texts)
    assert 0 not in found
