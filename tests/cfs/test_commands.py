from __future__ import annotations

import pytest

from edoras_tools.cfs.commands import NAMED, Argument, inject_line
from edoras_tools.cfs.names import COMMANDS


def test_every_command_is_one_that_its_application_has():
    for name, item in NAMED.items():
        assert name == "sbn-noop" or item.function_code in COMMANDS[item.msg_id], name


def test_payloads_have_the_lengths_that_the_applications_take():
    for item in NAMED.values():
        known = COMMANDS.get(item.msg_id, {}).get(item.function_code)
        text = {Argument.MSG_ID: "0x827", Argument.APP: "CFE_SB", Argument.RESET: "processor"}.get(
            item.argument, ""
        )
        if known and known.lengths:
            assert 8 + len(item.payload(text, 4)) in known.lengths


def test_a_line_to_paste_names_a_command_that_is_there():
    assert inject_line("to-add", "0x0827", "--limit", "8") == "edoras inject to-add 0x0827 --limit 8"
    assert inject_line("to-enable") == "edoras inject to-enable"
    with pytest.raises(KeyError):
        inject_line("to-jump")
