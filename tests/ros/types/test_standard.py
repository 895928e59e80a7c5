"""The standard messages kept as text, beside rosbags; as a program it writes them again."""

from __future__ import annotations

import json

import pytest
from rosbags.typesys import Stores, get_typestore

from edoras_tools.ros import TypeStore
from edoras_tools.ros.types import standard

ADDED = {"jazzy": {"nav_msgs/msg/Goals": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] goals\n"}}
"""What a distribution got after its release, and rosbags does not know of."""


def collect():
    """Return what ``standard.FILE`` holds, made from the installed rosbags."""
    stores = [store for store in Stores if store.value.startswith("ros2_")]
    types, now = {}, {}
    for store in stores:
        distro = store.value.removeprefix("ros2_")
        fields = get_typestore(store).fielddefs
        texts = {name: standard.converted(name, fields).text for name in fields} | ADDED.get(distro, {})
        for name in sorted({*texts, *now}):
            if name not in now or now[name] != texts.get(name):
                now[name] = types.setdefault(name, {})[distro] = texts.get(name)
    return {
        "distros": [store.value.removeprefix("ros2_") for store in stores],
        "types": dict(sorted(types.items())),
    }


def test_every_standard_message_is_what_rosbags_says():
    then, now = standard.standard, _standards(collect())
    for distro in standard.distros():
        kept, collected = then(distro), now[distro]
        both = kept.keys() & collected.keys()
        assert len(both) > 140
        assert {name: kept[name] for name in both} == {name: collected[name] for name in both}


def test_what_a_distribution_left_behind_is_gone():
    assert "actionlib_msgs/msg/GoalID" in standard.standard("kilted")
    assert "actionlib_msgs/msg/GoalID" not in standard.standard("lyrical")


@pytest.mark.parametrize("name", ["latest", "rolling"])
def test_the_newest_distribution_by_other_names(name):
    assert TypeStore(name).types() == TypeStore(standard.distros()[-1]).types()


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
    standard.FILE.write_text(json.dumps(collect(), indent=1) + "\n", encoding="utf-8")
