"""Whatever a packet holds: no line exceeds the width, and nothing but styles of ours reaches the terminal."""

from __future__ import annotations

import io
import re

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from edoras_tools.decode.lines import line_of
from edoras_tools.errors import WireError
from edoras_tools.links import table
from edoras_tools.model import OTHER, Datagram, Decoded, Endpoint, Finding, Layer, LayerField, RosMessage
from edoras_tools.render.capture import tree
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.terminal.palette import Paint
from edoras_tools.render.terminal.text import cells
from edoras_tools.words import TimeFormat

anything = st.text(st.characters(exclude_categories=()), max_size=30) | st.sampled_from(
    [
        "a.b.c",
        "a.b",
        "....",
        "[red]",
        ":smile:",
        "\x1b]0;title\x07",
        "你好" * 20,
        "x" * 300,
        "\u202e",
        "e\u0301" * 30,
    ]
)


def made(value, *parts):
    """Values of a class whose types only the type checker can name: Hypothesis cannot make it by itself."""
    return st.tuples(*parts).map(lambda items: value(*items))


values = st.recursive(
    st.integers() | st.floats() | st.booleans() | st.binary(max_size=40) | anything,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(anything, inner, max_size=3),
    max_leaves=6,
)
places = st.integers(-80, 120)
fields = made(LayerField, anything, values, places, places, anything, anything)
quick = settings(max_examples=examples(250), deadline=None)
names = st.sampled_from(["ccsds", "sbn", "cfe_command", "ros", ""]) | anything
layers = made(Layer, names, anything, places, places, st.lists(fields, max_size=4).map(tuple))
endpoints = made(Endpoint, st.ip_addresses().map(str) | anything, st.integers(0, 65535))
datagrams = st.tuples(
    st.integers(1, 10**9),
    st.integers(-(1 << 63), (1 << 63) - 1),
    st.just(1),
    st.binary(max_size=80),
    st.binary(max_size=80),
    st.integers(-1, 60),
    st.integers(0, 70000),
    endpoints,
    endpoints,
).map(lambda values: Datagram(*values))
packets = made(
    Decoded,
    datagrams,
    st.sampled_from([OTHER, *table.links()]),
    st.lists(layers, max_size=4).map(tuple),
    st.integers(0, (1 << 27) - 1).map(Finding),
    st.none() | made(RosMessage, anything, anything, st.just({}), st.just(b"")),
    st.none() | st.builds(WireError, anything),
    anything,
)


def check(line, width, *, colour):
    bare = re.sub(r"\x1b\[[0-9;]*m", "", line) if colour else line
    assert bare.isprintable()
    assert cells(bare) <= width
    line.encode()


@quick
@given(
    st.lists(packets, min_size=1, max_size=4),
    st.integers(20, 220),
    st.booleans(),
    st.sampled_from(TimeFormat),
    st.booleans(),
)
def test_packet_list(some, width, colour, time_format, verbose):
    view = PacketList(width, colour=colour, time_format=time_format, verbose=verbose)
    check(view.header(), width, colour=colour)
    for decoded in some:
        check(view.line(line_of(decoded)), width, colour=colour)


@quick
@given(packets, st.integers(40, 220), st.booleans())
def test_tree(decoded, width, colour):
    for line in tree.tree_lines(decoded, width, Paint(colour)):
        check(line, width, colour=colour)


@quick
@given(packets, st.integers(44, 220), st.booleans(), st.sampled_from(["payload", "frame"]))
def test_whole_packet(decoded, width, colour, base):
    for line in tree.packet_lines(decoded, width, colour=colour, base=base):
        check(line, width, colour=colour)


counts = st.integers(0, 10**7)
routes = st.fixed_dictionaries(
    {
        "topic": st.none() | anything,
        "type": st.none() | anything,
        "link": st.sampled_from(["ci", "to", "sbn", "other"]),
        "msg_id": st.none() | st.just("0x0827"),
        "count": counts,
    },
    optional={
        "name": st.none() | anything,
        "processor_id": st.none() | st.integers(0, 999),
        "rate_hz": st.floats(0, 1e6),
        "jitter_ms": st.floats(0, 1e6),
        "gaps": st.none() | counts,
        "duplicates": counts,
        "bytes_min": st.integers(0, 65535),
        "bytes_max": st.integers(0, 65535),
        "findings": st.dictionaries(
            st.sampled_from([item.label for item in Finding]), st.integers(1, 99), max_size=3
        ),
    },
)
summaries = st.fixed_dictionaries(
    {
        "datagrams": counts,
        "start_ns": st.integers(0, 1 << 62),
        "end_ns": st.integers(0, 1 << 62),
        "capture_drops": counts,
        "routes": st.lists(routes, max_size=4),
        "findings": st.dictionaries(st.sampled_from([item.label for item in Finding]), counts, max_size=3),
    },
    optional={
        "source": anything,
        "kind": anything,
        "warnings": st.lists(anything, max_size=2),
        "skipped": counts,
    },
)


@quick
@given(summaries, st.integers(80, 220))
def test_info(summary, width):
    out = io.StringIO()
    Console(file=out, width=width, color_system=None, _environ={}).print(capture_summary(summary))
    for line in out.getvalue().split("\n"):
        check(line, width, colour=False)


@pytest.mark.parametrize("markup", ["[red]x[/red]", "[/]", ":smile:"])
def test_markup_in_a_topic_is_only_text(markup):
    row = {"topic": markup, "link": "ci", "msg_id": "0x1827", "count": 1}
    out = io.StringIO()
    Console(file=out, width=80, _environ={}).print(capture_summary({"datagrams": 1, "routes": [row]}))
    assert markup in out.getvalue()
