"""Times that a user gives: after the capture's start, or of the clock."""

from __future__ import annotations

from datetime import date, datetime, timedelta, timezone
from zoneinfo import ZoneInfo

import pytest
import typer
from effort import every, long_but
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.cli.options import TimeOptions, at, moment, time_zone
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.older import UTC
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.selection import Period, Selection, find_packets
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

BEGIN = int(datetime(2026, 11, 21, 6, 18, 47, tzinfo=UTC).timestamp()) * SECOND
BERLIN = ZoneInfo("Europe/Berlin")


def period(start=None, end=None, tz=None):
    words = [None if text is None else moment(text) for text in (start, end)]
    return TimeOptions(*words, None if tz is None else time_zone(tz)).period()


@pytest.mark.parametrize(
    ("start", "tz", "seconds"),
    [
        ("13", None, 13),
        ("1.5min", None, 90),
        ("06:19", None, 13),
        ("6:19:00.5", None, 13.5),
        ("06:18", None, 0),
        ("05:18:48", None, 0),
        ("05:18:46", None, 82799),
        ("00:00", None, 63673),
        ("2026-11-21", None, 0),
        ("2026-11-22", None, 63673),
        ("2026-11-21T06:19:00.000000001", None, 13.000000001),
        ("2026-11-21 06:19Z", "Europe/Berlin", 13),
        ("2026-11-21T07:19+01:00", "UTC", 13),
        ("07:19", "Europe/Berlin", 13),
        ("01:19", "America/New_York", 13),
    ],
)
def test_start(start, tz, seconds):
    found = period(start, None, tz if tz or ":" not in start else "UTC").since(BEGIN)
    assert found.start_ns == round(seconds * SECOND)


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        ("06:19", "06:20", (13, 73)),
        ("06:19", "100", (13, 100)),
        ("20", "06:20", (20, 73)),
        ("23:50", "00:10", (63073, 64273)),
    ],
)
def test_start_and_end_may_be_of_two_kinds(start, end, expected):
    found = period(start, end).since(BEGIN)
    assert (found.start_ns, found.end_ns) == tuple(item * SECOND for item in expected)


@pytest.mark.parametrize(
    ("start", "end", "words"),
    [
        ("10", "5", "--end is not after --start"),
        ("2026-11-21T06:20", "10", "--end is not after --start"),
        (None, "2026-11-21T06:00", "is before the capture, which begins at 2026-11-21 06:18:47 UTC"),
        (None, "06:18:40", "is before the capture, which begins at 2026-11-21 06:18:47 UTC"),
        ("10", "06:18:50", "--end is not after --start"),
        ("06:19", "06:18:50", "--end is not after --start"),
        (None, "0", "nothing is left"),
    ],
)
def test_an_end_that_leaves_nothing_is_refused(start, end, words):
    with pytest.raises(ConfigError, match=words):
        period(start, end).since(BEGIN)


def test_capture_times_that_are_no_dates():
    with pytest.raises(ConfigError, match="are no dates"):
        period("06:19").since(1 << 62 << 8)


def test_a_zone_needs_a_clock_time():
    with pytest.raises(ConfigError, match="--tz is the zone of clock times"):
        period("5", None, "Europe/Berlin")


@pytest.mark.parametrize(
    ("text", "words"), [("Europe/Berln", "did you mean Europe/Berlin"), ("../../etc", "no time zone")]
)
def test_unknown_zones(text, words):
    with pytest.raises(typer.BadParameter, match=words):
        time_zone(text)


@pytest.mark.parametrize(
    "text", ["25:00", "12:60", "2026-02-30", "12:03:61", "2026-11-21T9", "soon", "-5", "nan"]
)
def test_no_time(text):
    with pytest.raises(typer.BadParameter):
        moment(text)


@given(
    st.datetimes(datetime(1990, 1, 1), datetime(2090, 1, 1)),  # noqa: DTZ001  the zone is drawn beside it
    st.sampled_from([UTC, BERLIN, timezone(timedelta(hours=-7))]),
    st.integers(0, 86399),
)
def test_a_clock_time_is_the_first_one_not_earlier(begin, where, second):
    begin_ns = int(begin.replace(tzinfo=UTC).timestamp()) * SECOND
    text = f"{second // 3600:02}:{second // 60 % 60:02}:{second % 60:02}"
    found = at(text, where).first(begin_ns)
    shown = datetime.fromtimestamp(found // SECOND, where)
    assert begin_ns <= found < begin_ns + 26 * 3600 * SECOND
    ambiguous = where is BERLIN and shown.strftime("%H:%M:%S") != text  # an hour that summer time leaves out
    assert ambiguous or shown.strftime("%H:%M:%S") == text


def test_a_length_instead_of_an_end():
    assert Period(length_ns=5 * SECOND, start=at("06:19", UTC)).since(BEGIN) == Period(
        13 * SECOND, 18 * SECOND
    )
    assert at("2026-11-21", UTC).day == date(2026, 11, 21)


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
