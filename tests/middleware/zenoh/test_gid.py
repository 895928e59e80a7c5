"""The hash against the reference implementation of xxHash: what it gave for many lengths."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.middleware.zenoh.gid import gid, xxh3

PATTERN = bytes((place * 131 + place // 7) % 256 for place in range(1200))


def test_every_length_as_the_reference_has_it():
    digest = hashlib.sha256()
    for length in range(17, 1200):
        low, high = xxh3(PATTERN[:length])
        digest.update(high.to_bytes(8, "big") + low.to_bytes(8, "big"))
    assert digest.hexdigest() == "4e4f1f49f3b19b7cf7b58bf6bf65952a8f9bb20a81d323b791f1517c2ab9c71c"


@pytest.mark.parametrize(
    ("length", "expected"),
    [
        (17, "9fb5d1df5f596243fe29229275898434"),
        (32, "8371440f439c0425c662d67c70c5b7a6"),
        (33, "30faa5eeaf230be598787a2bb7e6bb3c"),
        (64, "11b52e3a3a1ece0bd8045d029ce2e30a"),
        (96, "a1e6f13095f15ca01c22dad05a09df30"),
        (97, "af54c6a3feac4818a20e1a7d4cb2f974"),
        (128, "74c0202f0eccba84f6b9b88d64ef5981"),
        (129, "a002ff0408336266bb0134c2914d613f"),
        (160, "f7d29212cae82de61f914bd766d0926c"),
        (240, "70f8428cd244687592fb8120209f7d7e"),
        (241, "c6eb3a6aa19381d57315654a87656e22"),
        (1024, "ecb1ecee8b05bd5a660f17b831d36059"),
        (1025, "f48fa7f9904e60ba8dc958605ec1686e"),
        (1088, "80458eae30f9764843dc21f77e0a4bb4"),
        (1199, "5193f54e86ab27537bcf13110af7bcf3"),
    ],
)
def test_single_lengths(length, expected):
    low, high = xxh3(PATTERN[:length])
    assert f"{high:016x}{low:016x}" == expected


def test_an_id_is_the_low_half_first_each_little_endian():
    token = "@ros2_lv/0/1/0/0/NN/%/%/node"
    low, high = xxh3(token.encode())
    assert gid(token) == low.to_bytes(8, "little") + high.to_bytes(8, "little")


@given(st.text(min_size=17, max_size=400), st.text(min_size=17, max_size=400))
def test_different_tokens_have_different_ids(one, other):
    assert (gid(one) == gid(other)) == (one == other)
