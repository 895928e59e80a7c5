"""The longest message, beside the longest of all messages there are."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.codegen.bounds import Bounds
from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.ros import TypeStore
from edoras_tools.ros.types.schema import PRIMITIVES, Shape

KINDS = ("uint8", "int16", "int32", "float64", "string", "wstring")


def _values(store, field, strings, sequences):
    """Values of a field of every size."""
    texts = ["x" * length for length in range((field.string_bound or strings) + 1)]
    one = texts if field.type in {"string", "wstring"} else [0]
    if "/" in field.type:
        one = list(_messages(store, field.type, strings, sequences))
    if field.shape is Shape.SCALAR:
        return one
    counts = [field.size] if field.shape is Shape.ARRAY else range((field.size or sequences) + 1)
    return [list(items) for count in counts for items in product(one, repeat=count)]


def _messages(store, name, strings, sequences):
    fields = store.fields(name)
    for values in product(*(_values(store, field, strings, sequences) for field in fields)):
        yield {field.name: value for field, value in zip(fields, values, strict=True)}


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
@given(
    fields=st.lists(
        st.tuples(st.sampled_from(KINDS), st.sampled_from(["", "[]", "[2]", "[<=1]"])), min_size=1, max_size=3
    ),
    nested=st.lists(st.sampled_from(KINDS), min_size=1, max_size=2),
    strings=st.integers(1, 2),
)
def test_longest(distro, fields, nested, strings):
    inner = "".join(f"{kind} f{index}\n" for index, kind in enumerate(nested))
    outer = "".join(f"{kind}{shape} f{index}\n" for index, (kind, shape) in enumerate(fields))
    definitions = {"a/msg/Inner": inner, "a/msg/Outer": f"{outer}Inner last\nuint16 end\n"}
    store = TypeStore(distro, definitions=definitions)
    library = generate(store, LibraryOrder(("a/Outer",), Bounds(strings, 1))).library
    longest = max(len(store.encode("a/Outer", values)) for values in _messages(store, "a/Outer", strings, 1))
    assert library.requested[0].most_bytes == longest


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_arrays_are_not_walked(kind):
    """An array of a million takes no longer than one of two."""
    store = TypeStore(definitions={"a/msg/A": f"uint8 a\n{kind}[1000003] b\nfloat64 c\n"})
    made = generate(store, LibraryOrder(("a/A",))).library.requested[0]
    assert made.most_bytes == store.fixed_size("a/A")


def test_sequences_in_sequences_do_not_overflow():
    definitions = {"a/msg/A": "uint8[<=16777216] a\n", "a/msg/B": "A[<=3] a\n", "a/msg/C": "B[<=1] b\n"}
    made = generate(TypeStore(definitions=definitions), LibraryOrder(("a/C",))).library.requested[0]
    assert made.most_bytes == 4 + 4 + 4 + 3 * (4 + (1 << 24))
