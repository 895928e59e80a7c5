"""The text of messages, as rosidl's functions for ros2cli write it."""

from contextlib import suppress

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.ros_verbs.echo import TextOptions
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.ros import TypeStore

TYPES = TypeStore()
JOINTS, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
VALUES = {
    "header": {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "base"},
    "name": ["a", "b"],
    "position": [0.5, 1.0],
    "velocity": [],
    "effort": [2.0],
}


@pytest.mark.parametrize(
    ("form", "text"),
    [
        (
            TextOptions(),
            (
                "header:\n  stamp:\n    sec: 7\n    nanosec: 8\n  frame_id: base\nname:\n- a\n- b\n"
                "position:\n- 0.5\n- 1.0\nvelocity: []\neffort:\n- 2.0\n"
            ),
        ),
        (TextOptions(field="header.stamp"), "sec: 7\nnanosec: 8\n"),
        (TextOptions(field="header.frame_id"), "base\n"),
        (TextOptions(field="position", flow_style=True), "[0.5, 1.0]\n"),
        (TextOptions(field="name", truncate_length=1), "- a\n- '...'\n"),
        (TextOptions(field="header", csv=True), "7,8,base\n"),
        (TextOptions(csv=True), "7,8,base,a,b,0.5,1.0,2.0\n"),
        (TextOptions(field="header.frame_id", truncate_length=2), "ba...\n"),
        (TextOptions(field="header.frame_id", no_str=True), "'<string length: <4>>'\n"),
        (
            TextOptions(no_arr=True, csv=True),
            (
                "7,8,base,<sequence type: string, length: 2>,<sequence type: double, length: 2>,"
                "<sequence type: double, length: 0>,<sequence type: double, length: 1>\n"
            ),
        ),
    ],
)
def test_how_a_message_is_written(form, text):
    assert form.text(TYPES, JOINTS, TYPES.encode(JOINTS, VALUES)) == text


@pytest.mark.parametrize(
    ("field", "why"),
    [("pose", "has no field 'pose'; there are header, name"), ("header.stamp.sec.x", "has no field 'x'")],
)
def test_a_field_that_there_is_not(field, why):
    with pytest.raises(ConfigError, match=why):
        TextOptions(field=field).text(TYPES, JOINTS, TYPES.encode(JOINTS, VALUES))


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40))
def test_yaml_reads_the_text_again(data):
    text = TextOptions(full_length=True).text(TYPES, STRING, TYPES.encode(STRING, {"data": data}))
    assert yaml.safe_load(text) == {"data": data}


@given(st.binary(max_size=40))
def test_garbage_is_refused_by_the_documented_error(cdr):
    with suppress(WireError):
        TextOptions().text(TYPES, STRING, cdr)
