"""The add-ons: what the core can do without, a folder each, and the one table of what ships.

A folder can be deleted: what it added is then refused in a line, and nothing else changes. Nothing outside
imports an add-on; the core finds what they add through :mod:`edoras_tools.doors`, as it finds what packages
of other people add. An add-on may import all of the core, and no other add-on.

This file imports nothing of an add-on, so that reading the table costs nothing. docs/addons.md says how to
write one.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Final

import msgspec


class ListedCommand(msgspec.Struct, frozen=True):
    """A command of an add-on, as ``edoras --help`` lists it, also where the folder is absent.

    Attributes:
        group: heading under which it stands.
        help: first sentence of its help text, the same as in its code.
        place: place of its function or ``typer.Typer``; see ``Addon``.
        before: command of the same group that it stands before; the last one if empty.
    """

    group: str
    help: str
    place: str
    before: str = ""


class Addon(msgspec.Struct, frozen=True):
    """A row of the table; places are ``module:name`` in the folder, ``:name`` in its ``__init__.py``.

    Attributes:
        folder: name of the add-on.
        commands: its commands by name.
        adds: for each other kind of ``doors.KINDS``, places by name.
        extra: pip extra with the libraries that it needs; empty if it needs none.
    """

    folder: str
    commands: Mapping[str, ListedCommand] = {}
    adds: Mapping[str, Mapping[str, str]] = {}
    extra: str = ""

    def places(self, kind: str) -> dict[str, str]:
        """Return the places of everything of one kind, by name."""
        if kind == "commands":
            return {name: command.place for name, command in self.commands.items()}
        return dict(self.adds.get(kind, {}))


def _rules(*names: str) -> dict[str, str]:
    """Return the places of the rules of an add-on, by name."""
    return {name: f"rules:{name}" for name in names}


_LOOK, _RECORD, _EXPLAIN, _SEND, _CONNECT, _TRY = (
    partial(ListedCommand, group) for group in ("Look", "Record", "Explain", "Send", "Connect", "Try")
)

ADDONS: Final = (
    Addon(
        "plot",
        {"plot": _LOOK("Plot fields over time, with rates, losses and events.", "cli:plot", "host")},
    ),
    Addon(
        "mission_draft",
        {"mission": _CONNECT("Draft a mission file from what is in a capture.", "cli:mission")},
    ),
    Addon(
        "cfdp",
        {"files": _RECORD("Show the files that CFDP transferred, or take them out.", "cli:files")},
        {
            "links": {"cfdp": "link:CFDP"},
            "rules": _rules("file_checksum", "file_not_finished", "file_stalled", "file_pieces_resent"),
        },
    ),
    Addon(
        "archive",
        {"archive": _RECORD("Index many recordings, and ask the index.", "cli:archive")},
        extra="archive",
    ),
    Addon(
        "runs",
        {
            "check": _EXPLAIN("Check a capture against expectations, or draft them.", "cli:check"),
            "compare": _EXPLAIN("Compare runs by route: are the later ones worse?", "cli:compare", "check"),
        },
        {
            "parts": {
                "expected_run": "differences:unlike",
                "against": "cli:against",
                "bags": "cli:bags",
            }
        },
    ),
    Addon(
        "report",
        {
            "report": _EXPLAIN(
                "Write the doctor's findings as one HTML page with plots.", "cli:report", "compare"
            )
        },
        {"parts": {"report": "cli:report.__wrapped__"}},
    ),
    Addon(
        "debug_info",
        {"structs": _CONNECT("Turn C structs of flight software into ROS messages.", "cli:structs")},
    ),
    Addon(
        "codegen",
        {
            "codegen": _CONNECT(
                "Write messages in C for flight software: no ROS or heap.", "cli:codegen", "structs"
            ),
            "xtce": _CONNECT("Describe packets for ground systems: XTCE or COSMOS.", "cli:xtce"),
        },
    ),
    Addon(
        "proxy",
        {"proxy": _SEND("Relay a link: recorded, at limited rates, with faults.", "cli:proxy")},
    ),
    Addon(
        "lab",
        {
            "sweep": _SEND("Raise a route's rate or size until messages are lost.", "cli:sweep", "proxy"),
            "experiment": _TRY(
                "Make many runs, and say what each setting loses.", "cli:experiment", "samples"
            ),
            "demo": _TRY("Show the main features, or run a demo of the paper.", "cli:demo", "samples"),
            "sim": _TRY("Run an emulated cFS on loopback, with the real limits.", "cli:sim", "samples"),
        },
        {
            "middleware": {"local": ":LOCAL"},
            "parts": {"simulation": "emulator.simulation:start_simulation", "prove": "cli:prove"},
        },
    ),
    Addon(
        "fprime",
        adds={
            "links": {"fprime": "link:FPRIME"},
            "databases": {"fprime": "dictionary:DICTIONARIES"},
            "rules": _rules("fprime_packets_lost"),
        },
    ),
    Addon("databases", adds={"databases": {"eds": "eds:SHEETS", "xtce": "xtce.systems:SYSTEMS"}}),
    Addon("frames", adds={"links": {"frames": "link:FRAMES"}, "rules": _rules("frames_lost")}),
    Addon(
        "ros_args",
        adds={
            "parts": {"ros_args": "arguments:RosArguments", "ros_args_settings": "arguments:with_arguments"}
        },
    ),
    Addon("racs2", adds={"links": {"racs2": "link:RACS2"}}),
    Addon(
        "rtps",
        adds={
            "links": {"rtps": "link:RTPS"},
            "rules": _rules("dds_no_samples", "dds_lost", "dds_not_captured", "dds_resent"),
        },
    ),
    Addon(
        "operations",
        adds={"parts": {"metrics": "metrics:ServedWatcher", "after_split": "after_split:AfterSplit"}},
    ),
    Addon(
        "tables",
        adds={
            "parts": {
                "partition": "partition:export_by_recording",
                "arrow_tables": "arrow",
                "recordings": "partition:read_recordings",
                "performance_trace": "partition:export_trace",
            }
        },
        extra="analysis",
    ),
    Addon("snapshot", adds={"parts": {"snapshots": "cli"}}),
    Addon(
        "trace",
        {
            "trace": _LOOK("Follow one message hop by hop, or a topic's rounds.", "cli:trace", "host"),
            "hz": _LOOK("Show the rate of a topic, hop by hop.", "cli:hz", "host"),
        },
        {"parts": {"trace": "views:packet_ladder"}},
    ),
    Addon(
        "ros_verbs",
        {
            "topic": _LOOK("List topics, or say more of one.", "cli:topic", "host"),
            "echo": _LOOK("Print the messages of a topic.", "cli:echo", "host"),
            "bw": _LOOK("Show the bytes a second of a topic.", "cli:bw", "host"),
            "delay": _LOOK("Show how old messages are.", "cli:delay", "host"),
            "observe": _RECORD("Count what ROS 2 nodes exchange.", "cli:observe"),
            "play": _SEND("Publish a recording's messages in ROS 2.", "cli:play"),
        },
        {"parts": {"graph_hz": "cli:graph_hz"}},
    ),
    Addon("tui", adds={"parts": {"panes": "cli"}}, extra="tui"),
    Addon("zenoh", adds={"middleware": {"zenoh": ":ZENOH"}}, extra="zenoh"),
    Addon(
        "dds",
        adds={
            "middleware": {"dds": ":DDS"},
            "parts": {"dds_graph": "graph:open_graph", "dds_observer": "observer:dds_observer"},
        },
        extra="dds",
    ),
    Addon(
        "foxglove",
        {"live": _LOOK("Show a link or a recording in Foxglove.", "cli:live", "plot")},
        {
            "middleware": {"foxglove": ":FOXGLOVE"},
            "parts": {"foxglove": "player", "display": "cli", "monitor": "player:monitor"},
        },
        extra="live",
    ),
    Addon(
        "wireshark",
        {
            "wireshark": _CONNECT(
                "Decode the links in Wireshark and tshark, to ROS fields.", "cli.wireshark:wireshark", "xtce"
            )
        },
        {"parts": {"wireshark": "program:open_packets"}},
    ),
)
"""The add-ons that ship."""
LINK_PORTS: Final = {"cfdp": (5111, 5222), "fprime": (50000, 50001)}
"""Usual UDP ports of their links, which ``edoras host`` names without loading the links."""
