"""What names that tables show stand for."""

import pytest
from effort import every, long_but
from places import ROOT

from edoras_tools.errors import RouteError
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.names import find_packets
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files

CAPTURES = ["a_rover.pcap", "d3_cpu1_cpu2.pcap.gz", "e_ci_errors.pcap", "f_sbn_disconnect.pcap"]
MISSION = ROOT / "samples/missions/rover_ground.yaml"


@pytest.fixture(scope="module")
def rover():
    return Settings((MISSION,)).workbench()


def counted(capture, selection=None):
    source = open_files([ROOT / "samples/captures" / capture])
    bench = Settings((MISSION,)).workbench(source.info)
    return inspect(source, bench, selection=selection or Selection())


@pytest.mark.quick("f_sbn*")
@pytest.mark.parametrize("capture", long_but(CAPTURES[2:], CAPTURES))
def test_every_name_that_info_prints_chooses_what_it_counts(capture):
    rows = counted(capture).ledger.routes()
    names = {row[key] for row in rows for key in ("topic", "name", "msg_id") if row[key]}
    assert names
    for name in every(3, sorted(names)):
        own = sum(row["count"] for row in rows if name in {row["topic"], row["name"], row["msg_id"]})
        chosen = counted(capture, Selection(topics=[name])).ledger
        found = sum(
            row["count"] for row in chosen.routes() if name in {row["topic"], row["name"], row["msg_id"]}
        )
        assert found == own, name
        if name[0] not in "/0":
            assert chosen.datagrams == own, name


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("TO_CMDX", "did you mean TO_CMD?"),
        ("SBN_HARTBEAT", "did you mean SBN_HEARTBEAT?"),
        ("/cmd_ve", "did you mean /cmd_vel?"),
        ("zzz", "there are: /cmd_vel"),
        ("0x10000", "there are: "),
    ],
)
def test_an_unknown_name_is_told_with_what_was_meant(name, hint, rover):
    with pytest.raises(RouteError, match="no configured topic matches") as told:
        find_packets(name, rover.columns.context)
    assert hint in str(told.value)


def test_topics_of_the_robot_are_what_its_link_sends():
    for topic, name in (("/cfs/robot_command", "ROBOT_COMMAND"), ("cfs/robot_st*", "ROBOT_STATE")):
        chosen = (counted("a_rover.pcap", Selection(topics=[item])) for item in (topic, name))
        by_topic, by_name = (item.ledger for item in chosen)
        assert by_topic.routes() == by_name.routes()
        assert [row["name"] for row in by_topic.routes()] == [name]


def test_patterns_choose_several(rover):
    context = rover.columns.context
    assert {key.msg_id for key in find_packets("TO_*", context).keys} == {0x880, 0x881, 0x1880, 0x1881}
    assert len(find_packets("sbn_*", context).kinds) > 5
    assert len(find_packets("*", context).routes) == len(rover.mission.routes)
