"""What cFS wants to know of a mission: message ids, packets that fit, what Telemetry Output sends."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

from edoras_tools.codegen.layout import banner, guarded
from edoras_tools.codegen.names import comment, type_name
from edoras_tools.model import Link

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.mission import Mission, Route

MSGIDS: Final = "edoras_app_msgids.h"
PACKETS: Final = "edoras_app_msg.h"
SUBSCRIPTIONS: Final = "edoras_to_lab_subs.inc"
_LIMIT: Final = 4
"""Messages of one MsgId that may wait in TO_LAB's pipe, as in its own table."""


def side_files(mission: Mission, command: str) -> dict[str, str]:
    """Return the text of each file by its name; none for a mission without routes."""
    if not mission.routes:
        return {}
    routes = _named(mission.routes)
    return {
        MSGIDS: _msgids(routes, command),
        PACKETS: _packets(routes, command),
        SUBSCRIPTIONS: _subscriptions(routes, command),
    }


def _named(routes: Sequence[Route]) -> dict[str, Route]:
    """Return each route under its own name: key, side, and the MsgId where two would be called the same."""
    plain = [_plain(route) for route in routes]
    often = Counter(plain)
    return {
        name if often[name] == 1 else f"{name}_{route.msg_id:04X}": route
        for name, route in zip(plain, routes, strict=True)
    }


def _plain(route: Route) -> str:
    side = "FLIGHT" if route.link is Link.SBN else "GROUND"
    return f"EDORAS_APP_{re.sub(r'[^A-Za-z0-9]+', '_', route.key).strip('_').upper()}_{side}"


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
#define EDORAS_APP_SUBSCRIPTIONS \\
    {{ {listed} }}
"""
    about = "The MsgIds of the mission: what ROS topic and type each carries, and where it comes from."
    return banner(command, about) + guarded(MSGIDS, "".join(lines) + subscribed * bool(received))


def _about(route: Route) -> str:
    link = {Link.CI: "CI", Link.TO: "TO", Link.SBN: "SBN"}[route.link]
    way = f"from {link}" if route.to_cfs else f"to {link}"
    return comment(f"{way}: {route.topic}, {route.type}")


def _packets(routes: dict[str, Route], command: str) -> str:
    body = f'#include "cfe.h"\n#include "{MSGIDS}"\n#include "edoras_msgs.h"\n'
    for name, route in routes.items():
        if not route.to_cfs:
            kind, head = ("Command", "CmdHeader") if route.msg_id & 0x1000 else ("Telemetry", "TlmHeader")
            body += f"""
/** 0x{route.msg_id:04X}, {_about(route)} */
typedef struct
{{
    CFE_MSG_{kind}Header_t {head};
    uint8_t data[(2U * EDORAS_ENVELOPE_WORD) + {type_name(route.type)}__MAX_CDR];
}} {_camel(name)}_t;
"""
    about = (
        "The packets that the app sends, with space for the longest message. A packet that is sent whole\n"
        "takes that space on the link; CFE_MSG_SetSize before CFE_SB_TransmitMsg makes it as long as it is."
    )
    return banner(command, about) + guarded(PACKETS, body)


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def _subscriptions(routes: dict[str, Route], command: str) -> str:
    sent = [name for name, route in routes.items() if route.link is Link.TO and not route.to_cfs]
    rows = "".join(f"{{CFE_SB_MSGID_WRAP_VALUE({name}_MID), {{0, 0}}, {_LIMIT}}},\n" for name in sent)
    about = (
        f'Entries of TO_LAB\'s table: #include "{MSGIDS}" on top of to_lab_sub.c, and this file\n'
        " * inside TO_LAB_Subs, before its last entry. The last number is how many may wait in TO_LAB's pipe."
    )
    return banner(command, about) + rows
