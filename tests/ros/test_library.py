from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.ros import TypeStore, library
from edoras_tools.ros.library import OWN


def written(root, **files):
    for name, text in files.items():
        package, _, message = name.partition("__")
        file = root / package / "msg" / message.replace("_dot_", ".")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return root


def test_nothing_is_loaded_before_it_is_asked_for(monkeypatch):
    def loaded(*_):
        raise AssertionError

    monkeypatch.setattr("edoras_tools.ros.library.standard", loaded)
    types = TypeStore(definitions={"a/A": "int32 x\n"})
    assert types.definition("a/msg/A") == "int32 x\n"


def test_an_unknown_distribution_names_those_known():
    with pytest.raises(
        ConfigError, match=r"^distro 'noble' is not a ROS 2 .*foxy, galactic, humble, iron, jazzy.*rolling"
    ):
        TypeStore("noble")


def test_distributions_differ():
    assert not TypeStore("humble").has("type_description_interfaces/msg/FieldType")
    assert TypeStore("iron").has("type_description_interfaces/msg/FieldType")


def test_folders_are_searched_to_the_bottom(tmp_path):
    written(
        tmp_path / "src" / "deep",
        my_msgs__A_dot_msg="B b\nstd_msgs/Header h\n",
        my_msgs__B_dot_msg="int16 x 3\n",
    )
    types = TypeStore(msg_paths=[tmp_path])
    assert types.decode("my_msgs/msg/A", types.encode("my_msgs/msg/A", {}))["b"] == {"x": 3}
    assert "my_msgs/msg/B" in types.types()
    assert "MSG: std_msgs/Header\n" in types.definition("my_msgs/A")


def test_the_first_folder_wins_and_wins_over_the_distribution(tmp_path):
    one = written(tmp_path / "1", std_msgs__Int32_dot_msg="int8 mine\n")
    two = written(tmp_path / "2", std_msgs__Int32_dot_msg="int8 theirs\n", b_msgs__B_dot_msg="int8 b\n")
    types = TypeStore(msg_paths=[one, two], definitions={"std_msgs/msg/Int32": "int8 recorded\n"})
    assert types.definition("std_msgs/msg/Int32") == "int8 mine\n"
    assert types.has("b_msgs/msg/B")


def test_schemas_win_over_the_distribution():
    types = TypeStore(definitions={"std_msgs/msg/Int32": "int8 recorded\n"})
    assert types.definition("std_msgs/msg/Int32") == "int8 recorded\n"


def test_idl(tmp_path):
    text = (
        "module my_msgs { module msg {\n  module C_Constants { const int32 BIG = 9; };\n"
        '  struct C {\n    @verbatim (language="comment", text="x")\n    double x;\n'
        "    sequence<string<4>, 3> words;\n    wstring wide;\n    my_msgs::msg::D d;\n"
        "    octet raw[2];\n  };\n}; };\n"
    )
    other = "module my_msgs { module msg { struct D { float y; }; }; };\n"
    types = TypeStore(msg_paths=[written(tmp_path, my_msgs__C_dot_idl=text, my_msgs__D_dot_idl=other)])
    assert types.definition("my_msgs/msg/C").startswith(
        "int32 BIG=9\nfloat64 x\nstring<=4[<=3] words\nwstring wide\nmy_msgs/D d\nbyte[2] raw\n=="
    )
    values = {"x": 1.5, "words": ["ab"], "wide": "é", "d": {"y": 0.5}, "raw": [1, 2]}
    assert types.decode("my_msgs/msg/C", types.encode("my_msgs/msg/C", values)) == values


def test_idl_with_keys_and_includes(tmp_path):
    text = (
        '#include "my_msgs/msg/D.idl"\n\nmodule my_msgs{\n  module msg {\n    struct C {\n'
        "      @key uint32 id;\n      @key my_msgs::msg::D nested;\n      double value;\n    };\n  };\n};\n"
    )
    other = "module my_msgs { module msg { struct D { @key string key; int8 y; }; }; };\n"
    types = TypeStore(msg_paths=[written(tmp_path, my_msgs__C_dot_idl=text, my_msgs__D_dot_idl=other)])
    assert types.definition("my_msgs/msg/C").startswith("uint32 id\nmy_msgs/D nested\nfloat64 value\n==")


def test_idl_mistakes_name_the_line(tmp_path):
    root = written(
        tmp_path,
        a_msgs__A_dot_idl="module a_msgs { module msg {\n struct A {\n  dooble ; x\n};};};\n",
        a_msgs__B_dot_idl="module a_msgs { module msg { struct Other { double x; }; }; };\n",
        a_msgs__C_dot_idl="module a_msgs { module msg { struct C { long double x; }; }; };\n",
    )
    types = TypeStore(msg_paths=[root])
    assert "A.idl:2: not the IDL that ROS 2 writes" in types.check("a_msgs/msg/A")
    assert "B.idl:1: defines a_msgs/msg/Other, not a_msgs/msg/B" in types.check("a_msgs/msg/B")
    assert types.check("a_msgs/msg/C") == "a_msgs/msg/C.x: ROS 2 sends no float128"


def test_msg_mistakes_name_file_and_line(tmp_path):
    root = written(tmp_path, a_msgs__A_dot_msg="int32 x\nint32 y z\n", a_msgs__B_dot_msg="A a\n")
    types = TypeStore(msg_paths=[root])
    assert types.check("a_msgs/msg/A") == f"{root}/a_msgs/msg/A.msg:2: y: 'z' is not a valid int32"
    assert types.check("a_msgs/msg/B") == types.check("a_msgs/msg/A")
    with pytest.raises(ConfigError, match=r"A\.msg:2"):
        types.encode("a_msgs/msg/B", {})
    (root / "a_msgs" / "msg" / "A.msg").write_bytes(b"# \xff\n")
    assert types.check("a_msgs/msg/A") == f"{root}/a_msgs/msg/A.msg: cannot be read: not UTF-8"


def test_folders_without_definitions(tmp_path):
    (tmp_path / "Loose.msg").write_text("int32 x\n")
    with pytest.raises(ConfigError) as caught:
        TypeStore(msg_paths=[tmp_path, tmp_path / "none"])
    assert "no definition there; expected PACKAGE/msg/NAME.msg" in caught.value.mistakes[0]
    assert "no such file or folder" in caught.value.mistakes[1]


def test_a_single_file(tmp_path):
    root = written(tmp_path, a_msgs__A_dot_msg="int32 x\n", a_msgs__B_dot_msg="int32 x\n")
    types = TypeStore(msg_paths=[root / "a_msgs" / "msg" / "A.msg"])
    assert types.has("a_msgs/msg/A")
    assert not types.has("a_msgs/msg/B")


def test_a_sourced_ros(tmp_path, monkeypatch):
    written(tmp_path / "share", my_msgs__A_dot_msg="int32 x\n", std_msgs__Int32_dot_msg="int8 not_this_one\n")
    assert not TypeStore().has("my_msgs/msg/A")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}:")
    types = TypeStore()
    assert types.has("my_msgs/msg/A")
    assert "my_msgs/msg/A" in types.types()
    assert types.definition("std_msgs/msg/Int32") == "int32 data\n"


def test_our_own_messages_are_usable():
    types = TypeStore()
    own = [f"{file.parents[1].name}/msg/{file.stem}" for file in OWN.glob("*/msg/*.msg")]
    assert [types.check(name) for name in own if types.check(name)] == []


@pytest.mark.parametrize(
    "name", ["", "/", "a/../../b", "a//b", "../msg/x", "geometry_msgs/msg/", "a/msg/B\0", "é/msg/x"]
)
def test_odd_names_are_not_known(name):
    types = TypeStore()
    assert not types.has(name)
    with pytest.raises(RouteError, match="is not known to ROS 2 jazzy"):
        types.decode(name, b"")


HOSTILE = {
    "itself": ("A a\n", "the type contains itself: x_msgs/msg/A > x_msgs/msg/A"),
    "in a sequence": ("A[] a\n", "the type contains itself"),
    "huge": ("float64[4000000000] x\n", "its smallest message takes 32000000000 bytes"),
    "many strings": ("string[4000000000] x\n", "its smallest message takes 16000000000 bytes"),
    "unknown": ("Nothing x\n", "type 'x_msgs/msg/Nothing' is not known"),
}


@pytest.mark.parametrize(("text", "message"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_definitions(text, message):
    assert message in TypeStore(definitions={"x_msgs/msg/A": text}).check("x_msgs/msg/A")


def test_definitions_that_multiply():
    texts = {f"x_msgs/msg/L{level}": f"L{level + 1} a\nL{level + 1} b\n" for level in range(30)}
    types = TypeStore(definitions=texts | {"x_msgs/msg/L30": "int8 x\n"})
    assert "spells out more than 16384 values" in types.check("x_msgs/msg/L0")
    assert types.has("x_msgs/msg/L20")


def test_definitions_without_end():
    texts = {f"x_msgs/msg/L{level}": f"L{level + 1} a\n" for level in range(3000)}
    assert "contains itself" in TypeStore(definitions=texts).check("x_msgs/msg/L0")


def test_arrays_of_arrays_that_multiply():
    texts = {f"x_msgs/msg/L{level}": f"L{level + 1}[1000] a\n" for level in range(9)}
    types = TypeStore(definitions=texts | {"x_msgs/msg/L9": "string x\n"})
    assert "its smallest message takes" in types.check("x_msgs/msg/L0")


@settings(deadline=None)
@given(text=st.text(max_size=40), name=st.text(max_size=20) | st.just("a/msg/A"))
def test_garbage_schemas(text, name):
    types = TypeStore(definitions={name: text})
    for asked in (name, "a/msg/A"):
        if types.check(asked) is None:
            assert types.encode(asked, {})


ADDED = {"jazzy": {"nav_msgs/msg/Goals": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] goals\n"}}
"""What a distribution got after its release, and rosbags does not know of."""


def collect():
    """Return what ``standard.FILE`` holds, made from the installed rosbags."""
    stores = [store for store in Stores if store.value.startswith("ros2_")]
    types, now = {}, {}
    for store in stores:
        distro = store.value.removeprefix("ros2_")
        fields = get_typestore(store).fielddefs
        texts = {name: library.converted(name, fields).text for name in fields} | ADDED.get(distro, {})
        for name in sorted({*texts, *now}):
            if name not in now or now[name] != texts.get(name):
                now[name] = types.setdefault(name, {})[distro] = texts.get(name)
    return {
        "distros": [store.value.removeprefix("ros2_") for store in stores],
        "types": dict(sorted(types.items())),
    }


def test_every_standard_message_is_what_rosbags_says():
    then, now = library.standard, _standards(collect())
    for distro in library.distros():
        kept, collected = then(distro), now[distro]
        both = kept.keys() & collected.keys()
        assert len(both) > 140
        assert {name: kept[name] for name in both} == {name: collected[name] for name in both}


def test_what_a_distribution_left_behind_is_gone():
    assert "actionlib_msgs/msg/GoalID" in library.standard("kilted")
    assert "actionlib_msgs/msg/GoalID" not in library.standard("lyrical")


@pytest.mark.parametrize("name", ["latest", "rolling"])
def test_the_newest_distribution_by_other_names(name):
    assert TypeStore(name).types() == TypeStore(library.distros()[-1]).types()


def test_no_class_of_rosbags_is_made(monkeypatch):
    def made(*_):
        raise AssertionError

    monkeypatch.setattr("rosbags.typesys.get_typestore", made)
    assert TypeStore().has("sensor_msgs/msg/JointState")


def test_defaults_that_are_not_zero_are_kept():
    assert TypeStore().decode("geometry_msgs/msg/Quaternion", _quaternion())["w"] == 1.0


@pytest.mark.parametrize(("distro", "status"), [("humble", 0), ("iron", 0), ("jazzy", -2), ("kilted", -2)])
def test_a_position_that_was_not_set_is_no_fix(distro, status):
    types = TypeStore(distro)
    name = "sensor_msgs/msg/NavSatFix"
    assert types.decode(name, types.encode(name, {}))["status"]["status"] == status


def test_jazzy_has_goals():
    assert not TypeStore("iron").has("nav_msgs/msg/Goals")
    assert TypeStore("jazzy").definition("nav_msgs/msg/Goals") == TypeStore("kilted").definition(
        "nav_msgs/msg/Goals"
    )


def _quaternion():
    return TypeStore().encode("geometry_msgs/msg/Quaternion", {})


def _standards(table):
    """Return each distribution's definitions, as ``standard`` does, of another table."""
    found = {}
    for distro in table["distros"]:
        store = get_typestore(Stores("ros2_" + distro))
        until = table["distros"].index(distro) + 1
        found[distro] = {
            name: [texts[known] for known in table["distros"][:until] if known in texts][-1]
            for name, texts in table["types"].items()
            if name in store.fielddefs
        }
    return found


if __name__ == "__main__":
    library.FILE.write_text(json.dumps(collect(), indent=1) + "\n", encoding="utf-8")
