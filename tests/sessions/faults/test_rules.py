"""Rules as people write them, and what they are told where they cannot be read."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError
from edoras_tools.links.bare import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.sessions.faults.rules import (
    COMMON,
    FAULT_KINDS,
    NumberChange,
    Schedule,
    bits_per_second,
    change,
    parse_profile,
    parse_rule,
    probability,
    time_ns,
    volume,
)

GOOD = {
    "drop:0.1": ("drop", {}, {"probability": 0.1}),
    " drop : 10% , every = 3": ("drop", {}, {"probability": 0.1, "every": 3}),
    "checksum": ("checksum", {}, {"probability": 1.0}),
    "delay:200ms,from=1m,until=2m": (
        "delay",
        {"time": 200_000_000},
        {"from_ns": 60 * 10**9, "until_ns": 120 * 10**9},
    ),
    "truncate:0x10,p=0.5": ("truncate", {"bytes": 16}, {"probability": 0.5}),
    "packet-length:-3": ("packet-length", {"value": NumberChange(-3, relative=True)}, {}),
    "sbn-type:0x07": ("sbn-type", {"value": NumberChange(7, relative=False)}, {}),
    "rate:30,keep=latest,per=link": ("rate", {"hz": 30.0, "keep": "latest", "per": "link"}, {}),
    "bandwidth:256k,queue=2M": ("bandwidth", {"rate": 256e3, "queue": 2 * 10**6}, {}),
}


@pytest.mark.parametrize("text", GOOD)
def test_a_rule_is_read(text):
    kind, values, schedule = GOOD[text]
    rule = parse_rule(text)
    assert rule.kind.name == kind
    assert dict(rule.values) == {name: option.default for name, option in rule.kind.options.items()} | values
    assert rule.schedule == Schedule(**schedule)
    assert str(rule) == text


def test_scopes_are_read():
    rule = parse_rule("drop:1,link=ci|sbn,to=cfs,msg_id=0x1827|6184,sbn=APP|0x4,where=a == 1, b")
    assert rule.scope.links == {CI, SBN}
    assert rule.scope.to_cfs is True
    assert rule.scope.msg_ids == {0x1827, 0x1828}
    assert rule.scope.sbn_types == {3, 4}
    assert rule.scope.where == "a == 1, b"
    assert rule.enabled
    assert not parse_rule("drop:1,switch=off").enabled


BAD = {
    "drip:0.1": "fault drip:0.1: no such fault 'drip'; did you mean drop?",
    "": "no such fault ''; there are drop,",
    "drop:2": "p '2': a probability is needed",
    "drop:nan": "p 'nan': a probability is needed",
    "drop:0.1,p=0.2": "p is given twice",
    "delay": "delay needs time: how late",
    "delay:": "time '': a length of time is needed",
    "delay:1s,msgid=3": "delay takes no 'msgid'; did you mean msg_id?",
    "delay:1s,p": "p has no value; write p=VALUE",
    "delay:1s,,": "delay takes no ','; there are p,",
    "drop:1,link=cd": "link 'cd': one of ci, to, sbn",
    "drop:1,to=moon": "to 'moon': one of cfs, ground, bridge is needed",
    "drop:1,msg_id=0x11827": "msg_id '0x11827': MsgIds of 16 bits are needed",
    "drop:1,sbn=APPLE": "sbn 'APPLE': a number of 8 bits or one of NO_MSG",
    "drop:1,from=2s,until=1s": "until is not later than from",
    "drop:1,from=1s,until=9s,period=2s": "period is shorter",
    "rate:30,keep=last": "keep 'last': one of first, latest is needed",
    "rate:0": "hz '0': a rate is needed",
    "truncate:-1": "bytes '-1': a number of bytes is needed",
    "bandwidth:2T": "rate '2T': a bandwidth in bits a second is needed",
    "packet-length:x": "value 'x': a number to set is needed",
}


@pytest.mark.parametrize("text", BAD)
def test_a_mistake_is_pointed_at(text):
    with pytest.raises(ConfigError) as caught:
        parse_rule(text)
    assert BAD[text] in str(caught.value)
    assert caught.value.mistakes[0].startswith(f"fault {text}: ")


def test_all_mistakes_are_told_at_once():
    with pytest.raises(ConfigError) as caught:
        parse_rule("rate:x,keep=y,foo=1")
    assert len(caught.value.mistakes) == 3


def test_an_unknown_profile_is_told():
    with pytest.raises(ConfigError, match=r"no such profile 'luna'; did you mean lunar\? there are leo,"):
        parse_profile("luna")


@given(
    st.text(max_size=40)
    | st.tuples(st.sampled_from(sorted(FAULT_KINDS)), st.text(":,=0123456789kmsp", max_size=12)).map("".join)
)
def test_any_text_is_a_rule_or_a_mistake(text):
    try:
        rule = parse_rule(text)
    except ConfigError:
        return
    assert parse_rule(rule.text) == rule


def test_every_option_is_described():
    for kind in FAULT_KINDS.values():
        assert kind.doc
        assert kind.value in kind.options or kind.value in COMMON
        assert all(option.doc for option in kind.options.values())


def test_values_have_the_units_people_write():
    assert [time_ns(text) for text in ("1", "1.5s", "2m", "3us", "4ns", "1h")] == [
        10**9,
        15 * 10**8,
        120 * 10**9,
        3000,
        4,
        3600 * 10**9,
    ]
    assert probability("12.5%") == 0.125
    assert bits_per_second("2Mbit/s") == 2e6
    assert volume("64k") == 64_000
    assert (change("+3").apply(5), change("-3").apply(5), change("0xFF").apply(5)) == (8, 2, 255)
