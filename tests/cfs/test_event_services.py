"""Every event of cFS that is written down: what its text writes, its pattern reads."""

from __future__ import annotations

from string import Formatter

import pytest

from edoras_tools.cfs import command_ingest, edoras_app, event_services, sbn, software_bus, telemetry_output
from edoras_tools.cfs.event_services import EventText

MODULES = (command_ingest, edoras_app, event_services, sbn, telemetry_output)
EVENTS = [
    *(item for module in MODULES for item in vars(module).values() if isinstance(item, EventText)),
    *software_bus.EVENTS.values(),
]


@pytest.mark.parametrize("event", EVENTS, ids=lambda item: f"{item.app} {item.event_id} {item.text[:30]}")
def test_a_pattern_reads_what_the_text_writes(event):
    fields = [(name, form or "") for _, name, form, _ in Formatter().parse(event.text) if name]
    values = {name: 0x1827 + at if form else f"APP_{at}" for at, (name, form) in enumerate(fields)}
    message = event.text.format(**values)
    found = event.pattern.fullmatch(message)
    bases = {name: 10 if form.endswith("d") else 16 for name, form in fields if form}
    read = {
        name: int(text, bases[name]) if name in bases else text for name, text in found.groupdict().items()
    }
    assert read == values
    assert event.phrase in message
    assert len(event.phrase) > 5


def test_a_name_with_a_comma_is_read_whole():
    message = "Msg Limit Err,MsgId 0x1827,pipe A,B,sender C,D"
    found = software_bus.EVENTS[software_bus.MSG_LIMIT].pattern.match(message)
    assert found.groupdict() == {"msg_id": "1827", "pipe": "A,B", "sender": "C,D"}


def test_a_text_that_is_cut_is_not_read_as_another_value():
    assert sbn.UNKNOWN_PEER.pattern.search("ERROR: unknown peer 66:9:1") is None
    assert sbn.UNKNOWN_PEER.pattern.search("ERROR: unknown peer 66:") is None
