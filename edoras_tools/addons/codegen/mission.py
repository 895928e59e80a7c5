"""Generates what cFS needs of a mission: MsgIds, packet structs and the table of Telemetry Output."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.codegen.header import UMBRELLA
from edoras_tools.addons.codegen.layout import banner, guarded
from edoras_tools.addons.codegen.names import c_type_name, comment

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.mission import Mission, Route
    from edoras_tools.wire.msg_id import MsgIds

MSGIDS: Final = "edoras_mission/msgids.h"
_PACKETS_FILE: Final = "edoras_mission/packets.h"
_SUBSCRIPTIONS_FILE: Final = "edoras_mission/to_lab_subs.inc"
_LIMIT: Final = 4
"""Messages of one MsgId that may wait in TO_LAB's pipe, as in its own table."""


def side_files(mission: Mission, command: str) -> dict[str, str]:
    """Return the text of each file by its name; none for a mission without routes."""
    if not mission.routes:
        return {}
    routes = _named(mission.routes)
    return {
        MSGIDS: _msgids(routes, command),
        _PACKETS_FILE: _packets(routes, command, mission.msg_ids),
        _SUBSCRIPTIONS_FILE: _subscriptions(routes, command),
    }


def _named(routes: Sequence[Route]) -> dict[str, Route]:
    """Return each route under a unique name: key, side, and the MsgId where two names would be equal."""
    plain = [_plain(route) for route in routes]
    often = Counter(plain)
    return {
        name if often[name] == 1 else f"{name}_{route.msg_id:04X}": route
        for name, route in zip(plain, routes, strict=True)
    }


def _plain(route: Route) -> str:
    side = route.link.bridge.upper()
    return f"EDORAS_MISSION_{re.sub(r'[^A-Za-z0-9]+', '_', route.key).strip('_').upper()}_{side}"


def _msgids(routes: dict[str, Route], command: str) -> str:
    widest = max(map(len, routes))
    lines = [
        f"#define {name}_MID{' ' * (widest - len(name))} 0x{route.msg_id:04X} /**< {_about(route)} */\n"
        for name, route in routes.items()
    ]
    received = [f"{name}_MID" for name, route in routes.items() if route.to_cfs]
    listed = ", \\\n      ".join(received)
    subscribed = f"""
/** What the app subscribes to with CFE_SB_Subscribe: commands from the ground, state from the flight side. */
#define EDORAS_MISSION_SUBSCRIPTIONS \\
    {{ {listed} }}
"""
    about = "The MsgIds of the mission: what ROS topic and type each carries, and where it comes from."
    return banner(command, about) + guarded(MSGIDS, "".join(lines) + subscribed * bool(received))


def _about(route: Route) -> str:
    way = f"from {route.link.name}" if route.to_cfs else f"to {route.link.name}"
    return comment(f"{way}: {route.topic}, {route.type}")


def _packets(routes: dict[str, Route], command: str, msg_ids: MsgIds) -> str:
    body = f'#include "cfe.h"\n#include "{MSGIDS}"\n#include "{UMBRELLA}"\n'
    for name, route in routes.items():
        if not route.to_cfs:
            command_sent = msg_ids.is_command(route.msg_id)
            kind, head = ("Command", "CmdHeader") if command_sent else ("Telemetry", "TlmHeader")
            body += f"""
/** 0x{route.msg_id:04X}, {_about(route)} */
typedef struct
{{
    CFE_MSG_{kind}Header_t {head};
    uint8_t data[(2U * EDORAS_ENVELOPE_WORD) + {c_type_name(route.type)}__MAX_CDR];
}} {_camel(name)}_t;
"""
    about = (
        "The packets that the app sends, with space for the longest message. A packet that is sent whole\n"
        "takes that space on the link; CFE_MSG_SetSize before CFE_SB_TransmitMsg makes it as long as it is."
    )
    return banner(command, about) + guarded(_PACKETS_FILE, body)


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def _subscriptions(routes: dict[str, Route], command: str) -> str:
    sent = [name for name, route in routes.items() if route.link.only_from_cfs and not route.to_cfs]
    rows = "".join(f"{{CFE_SB_MSGID_WRAP_VALUE({name}_MID), {{0, 0}}, {_LIMIT}}},\n" for name in sent)
    about = (
        f'Entries of TO_LAB\'s table: #include "{MSGIDS}" on top of to_lab_sub.c, and this file\n'
        " * inside TO_LAB_Subs, before its last entry. The last number is how many may wait in TO_LAB's pipe."
    )
    return banner(command, about) + rows
