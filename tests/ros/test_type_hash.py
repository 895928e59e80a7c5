"""Hashes against those that ROS 2's own generator wrote into published packages."""

import re
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import EdorasError
from edoras_tools.ros import TypeStore
from edoras_tools.ros.type_hash import type_hash

PUBLISHED = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "diagnostic_msgs/msg/DiagnosticStatus": "b0e3e692ea2d54a8af2f4ef1930e8155"
    "6a2db55216b771f8a7d2724ed47bf0e4",
    "geometry_msgs/msg/Accel": "dc448243ded9b1fcbcca24aba0c22f013dae06c354ba2d849571c0a2a3f57ca0",
    "geometry_msgs/msg/Point": "6963084842a9b04494d6b2941d11444708d892da2f4b09843b9c43f42a7f6881",
    "geometry_msgs/msg/Quaternion": "8a765f66778c8ff7c8ab94afcc590a2ed5325a1d9a076ffff38fbce36f458684",
    "geometry_msgs/msg/Transform": "beb83fbe698636351461f6f35d1abb20010c43d55374d81bd041f1ba2581fddc",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/Vector3": "cc12fe83e4c02719f1ce8070bfd14aecd40f75a96696a67a2a1f37f7dbb0765d",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/Imu": "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "shape_msgs/msg/SolidPrimitive": "2802a15190aadc3f496584df4b0b4c5824d8a0b31aaef839faa75bc34dda38ac",
    "std_msgs/msg/Char": "3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9",
    "std_msgs/msg/Empty": "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""Bounded and unbounded sequences, arrays, bytes, characters, an empty message, deep nesting."""


@pytest.fixture(scope="module")
def jazzy():
    return TypeStore("jazzy")


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_hashes(jazzy, name):
    assert type_hash(jazzy, name) == "RIHS01_" + PUBLISHED[name]


def test_a_short_name_is_the_same_type(jazzy):
    assert type_hash(jazzy, "std_msgs/String") == "RIHS01_" + PUBLISHED["std_msgs/msg/String"]


def test_every_type_of_the_distribution_has_a_hash_of_its_own(jazzy):
    hashes = {name: type_hash(jazzy, name) for name in jazzy.types()}
    assert all(re.fullmatch(r"RIHS01_[0-9a-f]{64}", item) for item in hashes.values())
    assert len(set(hashes.values())) == len(hashes)


def hash_of(text, name="a_msgs/msg/A"):
    return type_hash(TypeStore(definitions={name: text}), name)


@pytest.mark.parametrize(
    "other",
    [
        "uint8 a\nstring<=3 b\nfloat32[2] c",
        "int8 z\nstring<=3 b\nfloat32[2] c",
        "int8 a\nstring b\nfloat32[2] c",
        "int8 a\nstring<=4 b\nfloat32[2] c",
        "int8 a\nstring<=3 b\nfloat32[3] c",
        "int8 a\nstring<=3 b\nfloat32[<=2] c",
        "int8 a\nstring<=3 b\nfloat32[] c",
        "string<=3 b\nint8 a\nfloat32[2] c",
        "int8 a\nwstring<=3 b\nfloat32[2] c",
    ],
)
def test_whatever_changes_the_message_changes_the_hash(other):
    assert hash_of("int8 a\nstring<=3 b\nfloat32[2] c") != hash_of(other)


def test_comments_constants_and_defaults_do_not_matter():
    plain = hash_of("int8 a\nstring b")
    assert hash_of("# text\nint8 X=4\nint8 a 5  # five\nstring b 'c'") == plain


def test_a_change_in_a_type_that_is_used_matters():
    outer = "B one\nB[] many\n" + "=" * 80 + "\nMSG: a_msgs/B\n"
    assert hash_of(outer + "int8 x\n") != hash_of(outer + "int16 x\n")


def test_unknown_types_are_told_by_name(jazzy):
    with pytest.raises(EdorasError, match="no_msgs/msg/No"):
        type_hash(jazzy, "no_msgs/msg/No")


@given(st.text())
def test_any_name_gives_a_hash_or_an_error(name):
    with suppress(EdorasError):
        assert type_hash(TypeStore(definitions={"a_msgs/msg/A": "int8 a"}), name)
