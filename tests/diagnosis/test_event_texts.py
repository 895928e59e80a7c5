"""Events cut short or garbled: the doctor takes them for what they say, and never fails."""

from __future__ import annotations

import pytest
from effort import every, examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.wire import cfe, sbn

TEXTS = [
    ("CFE_SB", 14, "No subscribers for MsgId 0x18ee,sender CI_LAB_APP"),
    ("CFE_SB", 15, "Send Err:Msg Too Big MsgId=0x1827,app=CI_LAB_APP,size=65542,MaxSz=32768"),
    ("CFE_SB", 17, "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"),
    ("CFE_SB", 17, "Msg Limit Err,MsgId 0x827,pipe TO_LAB_TLM_PIPE,sender EDORAS_APP"),
    ("CFE_SB", 17, "Msg Limit Err,MsgId 0x82a,pipe SBN_3_66_Pipe,sender EDORAS_APP"),
    ("CFE_SB", 21, "Send Err:Invalid MsgId(0xffff)in msg,App CI_LAB_APP"),
    ("CFE_SB", 25, "Pipe Overflow,MsgId 0x827,pipe TO_LAB_TLM_PIPE,sender EDORAS_APP"),
    ("CFE_EVS", 44, "Events squelched, AppName = SBN"),
    ("CFE_ES", 23, "Invalid msg length: ID = 0x1806,  CC = 0, Len = 12, Expected = 8"),
    ("CI_LAB_APP", 8, "CI: L369, cmd 1827 00 dropped, bad length=7"),
    ("CI_LAB", 8, "CI: cmd dropped - length mismatch, 20 (hdr) / 8 (packet)"),
    ("EDORAS_APP", 2, "Invalid ground command code: CC = 9"),
    ("EDORAS_APP", 6, "Invalid Msg length: ID = 0x1827,  CC = 0, Len = 76, Expected = 8"),
    ("SBN", 1, "SBN protocol version mismatch with peer 66:3, my version=11, peer version 10"),
    ("SBN", 5, "Disconnected from peer 66:3."),
    ("SBN", 6, "version number mismatch with peer CpuID 3"),
    ("SBN", 10, "ERROR: could not process peer message: unknown message type 0x00000007"),
    ("SBN", 10, "unknown peer (ProcessorID=9)"),
    ("SBN", 259, "ERROR: unknown peer 66:9"),
    ("TO_LAB_APP", 3, "TO telemetry output enabled for IP 127.0.0.1"),
    ("TO_LAB_APP", 9, "L344 TO: Invalid Function Code Rcvd In Ground Command 0x4d"),
]
SCRAPS = st.sampled_from(
    ["", ":", "::", "0x", ",", " ", "\u00b2", "\u0663", "-", "(", "[", "99999999999999999999"]
)


@st.composite
def spoilt(draw):
    app, number, text = draw(st.sampled_from(TEXTS))
    text = text[: draw(st.integers(0, len(text)))]
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(text)))
        text = text[:at] + draw(SCRAPS) + text[at + draw(st.integers(0, 4)) :]
    return app, number, text


@pytest.mark.long
@settings(max_examples=examples(60), deadline=None)
@given(st.lists(spoilt(), min_size=1, max_size=12))
def test_no_text_of_an_event_ends_the_diagnosis(lab, events):
    told = [lab.event(4 + at / 4, *event) for at, event in enumerate(events)]
    diagnosis = lab.examine(_traffic(lab, *told), lab.missions("two-rovers"))
    diagnosis.as_json()


@pytest.mark.each(7)
@pytest.mark.parametrize(("app", "number", "text"), TEXTS)
def test_no_text_of_an_event_is_cut_badly(app, number, text, lab):
    told = [lab.event(4 + at / 20, app, number, text[:at]) for at in every(7, range(len(text) + 1))]
    lab.examine(_traffic(lab, *told), lab.missions("two-rovers")).as_json()


@pytest.mark.each(2)
@pytest.mark.parametrize("name", ["66:", ":9", "66", "66:9:1", "66:\u00b2", "66:99999999999999999999"])
def test_a_peer_whose_name_is_cut_is_nobody(name, lab):
    told = lab.event(5, "SBN", 259, f"ERROR: unknown peer {name}")
    assert not [item for item in lab.examine(_traffic(lab, told)).verdicts if item.rule == "unknown_peer"]


def _traffic(lab, *events):
    sent, _ = lab.simulate("two-rovers", seconds=10)
    bad = [
        lab.network(3.9, 7),
        lab.network(4.1, sbn.MsgType.PROTO, sbn.emit_proto(10)),
        lab.at(4.2, lab.ground, lab.ci, b"\x18\x27\0"),
        lab.at(4.3, lab.ground, lab.ci, cfe.emit_command(0x18EE, 1, bytes(8), sequence_flags=0)),
    ]
    return lab.merged(sent, *bad, *events)
