"""Software Bus Network (SBN over UDP): its name in events, its MsgIds, its times, its events.

The sources have 5, 10 and 10 seconds and compare whole seconds with "greater than", so each event comes a
second later. The values here are the measured ones.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from edoras_tools.cfs.event_services import EventText, EventType
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from edoras_tools.model import Peer

NAME: Final = "SBN"
PIPE: Final = "SBN_CMD_PIPE"
COMMAND_MSG_ID: Final = 0x18FA
HOUSEKEEPING_MSG_ID: Final = 0x08FA
TABLE: Final = "SBN.SBN_ConfTbl"
RESET_PEER, HOUSEKEEPING, RELOAD = 2, 10, 110
"""Function codes; Table Services sends the last one, with 4 bytes, when the table has a new image."""

HEARTBEAT_S: Final = 6
"""Whole seconds without sending, after which a heartbeat is sent to a connected peer."""
TIMEOUT_S: Final = 11
"""Whole seconds of silence, after which a peer is disconnected."""
ANNOUNCE_S: Final = 11
"""Whole seconds between announcements to a peer that is not connected."""
WAKE_NS: Final = 200 * MILLISECOND
"""Period at which peer pipes are served and times checked.

Incoming datagrams are read by a separate task that does not wait: 400 datagrams at once all arrived."""
PIPE_DEPTH: Final = 32
PEER_MSG_LIMIT: Final = 8
"""Most messages of one MsgId that may wait in a peer's pipe."""
PEER_PIPE: Final = re.compile(r"SBN_[0-9]+_[0-9]+_Pipe|pipe of an SBN peer")

VERSION_MATCH: Final = EventText(NAME, 1, "SBN protocol version match with peer {peer}")
VERSION_MISMATCH: Final = EventText(
    NAME,
    1,
    "{failure}SBN protocol version mismatch with peer {peer}, my version={own:d}, peer version {version:d}",
    EventType.ERROR,
)
_LOADED: Final = (
    "checking if module ({name}) already loded",
    "symbol not yet loaded ({symbol})",
    "loading module (Name={name}, File=/cf/{file}.so)",
    "validating symbol load ({symbol})",
    "initializing {kind} module",
)
STARTING: Final = (
    *(EventText(NAME, 4, text) for text in _LOADED),
    EventText(NAME, 4, "{kind} module initialized"),
)
"""Events about a module that it loads; a filter's own event comes before the last one."""
RESTARTING: Final = (STARTING[0], EventText(NAME, 4, "symbol already loaded ({symbol})"), *STARTING[4:])
"""Events about a module after a reload."""
MODULES: Final = (
    {"name": "UDP", "symbol": "SBN_UDP_Ops", "file": "sbn_udp", "kind": "protocol"},
    {"name": "Remap", "symbol": "SBN_F_Remap", "file": "sbn_f_remap", "kind": "filter"},
)
FILTER_INITIALIZED: Final = EventText(NAME, 4096, "SBN_F_Remap Lib Initialized.")
CONFIGURING: Final = EventText(NAME, 4, "configuring peer (SC={spacecraft_id:d}, CPU={processor_id:d})...")
OWN_NET: Final = (
    EventText(NAME, 4, "found new highest net id: 0"),
    EventText(NAME, 4, "increasing net count to 1"),
    EventText(NAME, 4, "peer is this processor: loading net 0"),
    EventText(NAME, 258, "configuring net (NetData={net}, Address={address}:{port:d})"),
)
OTHER_PEER: Final = (
    EventText(NAME, 4, "peer is other processor: loading peer onto net 0"),
    EventText(
        NAME, 258, "configuring peer (SC={spacecraft_id:d}, CPU={processor_id:d}, Address={address}:{port:d})"
    ),
)
ADDRESS: Final = (
    EventText(NAME, 258, "addr host: '{address}'"),
    EventText(NAME, 258, "addr port: '{port:d}'"),
)
NET_CONFIGURED: Final = EventText(NAME, 258, "configured (NetData={net})")
PEER_CONFIGURED: Final = EventText(
    NAME, 258, "configured peer (SC={spacecraft_id:d}, CPU={processor_id:d}, Address={address}:{port:d})"
)
STARTS_AFTER_NS: Final = 100 * MILLISECOND
"""Time from its first event to these events."""
SUBSCRIBED_TO_COMMANDS: Final = EventText(
    NAME, 2, "SBN subscribed to command pipe SBN_CMD_MID 0x{msg_id:04X}"
)
RECEIVE_TASK_STARTED: Final = EventText(NAME, 5, "Creating recv task for net 0")
PIPE_CREATED: Final = EventText(NAME, 5, "Created peer pipe '{pipe}'")
CONNECTED: Final = EventText(NAME, 5, "Peer {peer} connected.")
DISCONNECTED: Final = EventText(NAME, 5, "Disconnected from peer {peer}.")
OTHER_IDENT: Final = EventText(
    NAME, 6, "version number mismatch with peer CpuID {processor_id:d}", EventType.ERROR
)
HOUSEKEEPING_SENT: Final = EventText(NAME, 7, "hk command")
BARE_RELOAD: Final = EventText(
    NAME,
    7,
    "Recevied tbl reload command, but message was wrong size. This command should only be triggered from "
    "the TBL service, itself, and not called directly.",
    EventType.ERROR,
)
RELOAD_LENGTH: Final = EventText(
    NAME,
    7,
    "invalid message length (Name=reloadtbl ID=0x006E CC=110 Len={length:d} Expected={expected:d})",
    EventType.ERROR,
)
RELOADING: Final = (
    EventText(NAME, 7, "reload tbl command"),
    EventText(NAME, 4, "re-initializing SBN with new configuration..."),
    EventText(NAME, 4, "unloading configuration"),
)
SENDING_DISCONNECT: Final = EventText(NAME, 259, "peer {peer} - sending disconnect")
UNLOADED: Final = EventText(NAME, 259, "unloaded peer: {index:d}\n")
NET_ENDED: Final = EventText(NAME, 4, "Terminated net: 0")
UNSUBSCRIBED: Final = EventText(NAME, 8, "unsubscribed 0 message id's from ProcessorID {processor_id:d}")
ALREADY_DISCONNECTED: Final = EventText(
    NAME, 5, "ERROR: could not disconnect peer: already not connected to peer {peer}", EventType.ERROR
)
RELOADED: Final = EventText(NAME, 4, "SBN re-initialized.")
NOT_RELOADED: Final = (
    EventText(NAME, 5, "unable to update table", EventType.ERROR),
    EventText(NAME, 5, "ERROR: could not reload SBN configuration: could not clean up SBN", EventType.ERROR),
)
WITHOUT_PIPE: Final = (
    EventText("CFE_SB", 19, "Rcv Err:PipeId 1441805 does not exist,app SBN", EventType.ERROR),
    EventText(NAME, 3, "err from rcvmsg on sub pipe", EventType.ERROR),
    EventText(NAME, 5, "SBN_CheckSubscriptionPipe failed.", EventType.ERROR),
)
"""Events of each wake-up after a failed reload: its pipes are gone."""
NOT_SUBSCRIBED: Final = EventText(
    NAME, 8, "cannot process unsubscription from ProcessorID {processor_id:d}, msg 0x{msg_id:04X} not found"
)
NOT_PROCESSED: Final = "ERROR: could not process peer message: "
"""``failure`` in the texts of this build."""
UNKNOWN_TYPE: Final = EventText(NAME, 10, "{failure}unknown message type 0x{msg_type:08x}", EventType.ERROR)
MESSAGE_FAILED: Final = EventText(NAME, 10, "SBN_ProcessNetMsg failed: 0x00000001", EventType.ERROR)
RECEIVE_FAILED: Final = EventText(
    NAME,
    10,
    "ERROR: during SBN Receive Net Task: RecvFromNet failed for net 0: status=0x00000001",
    EventType.ERROR,
)
CONNECTING: Final = EventText(NAME, 259, "connecting to peer {peer}")
TIMED_OUT: Final = EventText(NAME, 259, "disconnected peer {peer}")
UNKNOWN_PEER: Final = EventText(
    NAME, 259, "ERROR: unknown peer {spacecraft_id:d}:{processor_id:d}", EventType.ERROR
)
UNKNOWN_PROCESSOR: Final = EventText(NAME, 10, "unknown peer (ProcessorID={processor_id:d})")
"""Event of the newest public SBN instead."""
NOT_UNPACKED: Final = EventText(NAME, 259, "ERROR: could not unpack message", EventType.ERROR)
BAD_MSG_ID: Final = EventText(NAME, 4097, "unable to set msgid", EventType.ERROR)


def peer_pipe(peer: Peer) -> str:
    """Return the name of a peer's pipe."""
    return f"SBN_{peer.processor_id}_{peer.spacecraft_id}_Pipe"
