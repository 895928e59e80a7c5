"""Names of nodes and topics, case by case, as rclpy resolves them: the same table judges both."""

from random import Random

import pytest
from ros_wheels import APART, asked

from edoras_tools.addons.ros_args.arguments import RosArguments
from edoras_tools.addons.ros_args.names import Remap, remapped_node, remapped_topic
from edoras_tools.errors import ConfigError
from edoras_tools.mission.bridges import full_topic

LONGEST = "/" + 246 * "a"
CASES = (
    # words after --ros-args, namespace, the node's name, topic to what it becomes; None: refused
    ("", "", "/bridge", {
        "cmd_vel": "/cmd_vel", "/cmd_vel": "/cmd_vel", "a/b": "/a/b", "~/out": "/bridge/out", "~": "/bridge",
        "{node}/x": "/bridge/x", "{ns}/x": None, "/{ns}/x": None, "a__b": "/a__b", "_a": "/_a", "a_": "/a_",
        "__a": "/__a", "a/": None, "//a": None, "/a//b": None, "9a": None, "a/9b": None, "~out": None,
        "a~b": None, "": None, "/": None, "a-b": None, "{other}": None, LONGEST: LONGEST, LONGEST + "a": None,
    }),
    ("", "/robot_1", "/robot_1/bridge", {
        "cmd_vel": "/robot_1/cmd_vel", "/cmd_vel": "/cmd_vel", "a/b": "/robot_1/a/b",
        "~/out": "/robot_1/bridge/out", "~": "/robot_1/bridge", "{node}/x": "/robot_1/bridge/x",
        "{ns}/x": "/robot_1/x", "{namespace}/x": "/robot_1/x", "/{ns}/x": None, "/x{ns}": "/x/robot_1",
    }),
    ("-r __ns:=/robot_1", "", "/robot_1/bridge", {
        "cmd_vel": "/robot_1/cmd_vel", "~/out": "/robot_1/bridge/out", "/cmd_vel": "/cmd_vel",
    }),
    ("-r __ns:=/a/b", "/c", "/a/b/bridge", {"x": "/a/b/x"}),
    ("-r __ns:=/", "/a", "/bridge", {"x": "/x", "~/x": "/bridge/x"}),
    ("-r __ns:=/q -r __ns:=/z", "", "/q/bridge", {"x": "/q/x"}),
    ("-r __node:=other", "", "/other", {"x": "/x", "~/x": "/other/x"}),
    ("-r __name:=other", "", "/other", {"~/x": "/other/x"}),
    ("-r bridge:__node:=other -r other:__ns:=/n", "", "/n/other", {"x": "/n/x", "~/x": "/n/other/x"}),
    ("-r bridge:__node:=other -r bridge:__ns:=/n", "", "/other", {"x": "/x"}),
    ("-r bridge:__node:=other -r other:a:=x -r bridge:a:=y", "", "/other", {"a": "/x"}),
    ("-r nobody:a:=x", "", "/bridge", {"a": "/a"}),
    ("-r a:=x", "/r", "/r/bridge", {"a": "/r/x", "/a": "/a", "/r/a": "/r/x"}),
    ("-r /a:=/x", "/r", "/r/bridge", {"a": "/r/a", "/a": "/x"}),
    ("-r a:=/x", "/r", "/r/bridge", {"a": "/x", "/r/a": "/x"}),
    ("-r ~/out:=x", "/r", "/r/bridge", {"~/out": "/r/x", "/r/bridge/out": "/r/x", "out": "/r/out"}),
    ("-r a:=~/x", "/r", "/r/bridge", {"a": "/r/bridge/x"}),
    ("-r a:=b -r a:=c -r b:=d", "/r", "/r/bridge", {"a": "/r/b", "b": "/r/d"}),
    ("-r a:=b -r b:=a", "", "/bridge", {"a": "/b", "b": "/a"}),
    ("-r __ns:=/q -r a:=x", "", "/q/bridge", {"a": "/q/x", "/a": "/a"}),
    ("-r a:=x -r __ns:=/q", "", "/q/bridge", {"a": "/q/x", "/a": "/a"}),
    ("-r rostopic://a:=b", "", "/bridge", {"a": "/b"}),
    ("-r rosservice://a:=b", "", "/bridge", {"a": "/a"}),
    ("-r bridge:rostopic://a:=b", "", "/bridge", {"a": "/b"}),
    ("--remap a:=b", "", "/bridge", {"a": "/b"}),
    ("-r _a:=b_", "", "/bridge", {"_a": "/b_"}),
    ("--log-level info -e /x --disable-stdout-logs --enable-rosout-logs", "", "/bridge", {"a": "/a"}),
    ("-p a:=1 -p bridge:a.b:=text -p c:=[1,2]", "", "/bridge", {"a": "/a"}),
    *((words, "", None, {}) for words in (
        "-r", "-r a", "-r a:=", "-r :=a", "-r a:=9c", "-r 9:=c", "-r a-b:=c", "-r /a//b:=c", "-r a:=b/",
        "-r a__b:=c", "-r a:=c__d", "-r *:=b", "-r /**:=b", r"-r a:=/b/\1", "-r {node}:=b", "-r a:={node}/b",
        "-r a:=rostopic://b", "-r __ns:=robot_1", "-r __ns:=/a__b", "-r __ns:=/a/", "-r __ns:=~/a",
        "-r __node:=a/b", "-r __node:=9x", "-r /bridge:__node:=x", "-r /r/bridge:a:=x", "-r ~:=x",
        "a:=b", "__ns:=/b", "-x a:=b", "-ra:=b", "--remap=a:=b",
        "-p a", "-p a:=", "-p :=1", "-p 9a:=1", "-p /r/bridge:a:=1", "-p a:=[1,x]", "-p a:={b:c}",
        "--params-file /there/is/none", "--log-level",
    )),
)  # fmt: skip
"""What rclpy of Jazzy and of Kilted said of each; ``test_rclpy_resolves_...`` asks it again."""


def ours(words, namespace, topics):
    """Return the names that ``ros_names.py`` prints."""
    try:
        RosArguments(words, lambda _: "no such file")
        rules = [Remap.of_text(words[at + 1]) for at, word in enumerate(words) if word in {"-r", "--remap"}]
    except ConfigError:
        return None
    node = "/".join(remapped_node(rules, namespace, "bridge"))
    full = [full_topic(topic, node) for topic in topics]
    return [node, *(remapped_topic(rules, node, topic) if topic else None for topic in full)]


@pytest.mark.parametrize(("words", "namespace", "node", "topics"), CASES)
def test_names_are_those_of_the_table(words, namespace, node, topics):
    expected = None if node is None else [node, *topics.values()]
    assert ours(words.split(), namespace, topics) == expected


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_rclpy_resolves_every_case_of_the_table(name):
    cases = [(namespace, words.split(), list(topics)) for words, namespace, _, topics in CASES]
    for (words, _, node, topics), names in zip(
        CASES, [item and item[0] for item in asked(name, cases)], strict=True
    ):
        assert names == (None if node is None else [node, *topics.values()]), words


def random_case(dice):
    """Return a case of rules that may be wrong, over few names, so that they meet."""
    parts = ["a", "b", "bridge", "a/b", "_a", "a_", "a1"]

    def name():
        return dice.choice(["", "", "/", "~/"]) + dice.choice(parts)

    def rule():
        of = dice.choice(["", "", "", "bridge:", "b:"])
        inner = f"{name()}:={name()}"
        return of + dice.choice([inner, inner, inner, f"__ns:=/{dice.choice(parts)}", "__node:=b"])

    words = [word for _ in range(dice.randrange(5)) for word in ("-r", rule())]
    return dice.choice(["", "/a", "/a/b"]), words, [name() for _ in range(8)]


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_random_rules_are_resolved_as_rclpy_does(name):
    dice = Random(39)
    cases = [random_case(dice) for _ in range(200)]
    answers = [item and item[0] for item in asked(name, cases)]
    assert sum(names is not None for names in answers) > 40
    for case, names in zip(cases, answers, strict=True):
        assert ours(case[1], case[0], case[2]) == names, case
