"""The meaning of each finding, and its severity."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from edoras_tools.model import Finding


class Level(IntEnum):
    """Severity of a finding for the sender of the datagram."""

    NOTE = 1
    """Usual for these senders; nothing is lost."""
    WARNING = 2
    """Unusual, or lost only at some receivers."""
    ERROR = 3
    """Refused, lost, corrupted or unreadable."""

    @property
    def label(self) -> str:
        """``note``, ``warning`` or ``error``."""
        return self.name.lower()

    @property
    def style(self) -> str:
        """The rich style of this severity, the same in every view."""
        return ("", "bright_blue", "yellow", "bold red")[self]

    @property
    def mark(self) -> str:
        """One character that shows the severity without colour."""
        return (" ", "·", "!", "✗")[self]


class Explanation(NamedTuple):
    """The explanation of a finding.

    Attributes:
        severity: severity.
        short: two or three words, for the packet list.
        meaning: one sentence: the fault, and the receiver's reaction.
    """

    severity: Level
    short: str
    meaning: str


def _of(severity: Level) -> Callable[[str], Explanation]:
    """Return a function of the short words and the sentence, joined by a colon, that makes an explanation."""
    return lambda text: Explanation(severity, *text.split(": ", 1))


_note, _warning, _error = map(_of, Level)

EXPLANATIONS: Final = {
    Finding.TRUNCATED: _error(
        "truncated: A layer needs more bytes than the datagram has; CI drops commands shorter than 8 bytes, "
        "and an app that gets a cut one cannot read it, or reads old bytes of its buffer."
    ),
    Finding.LENGTH_MISMATCH: _warning(
        "length field: The packet data length field differs from the number of bytes received; CI accepts "
        "that silently."
    ),
    Finding.CHECKSUM_BAD: _warning(
        "checksum: The command's checksum is neither 0 nor correct; no cFS app here checks it, so it is "
        "executed; of a transfer frame, a CFDP PDU or an own envelope, its CRC is wrong, and its receiver "
        "drops it."
    ),
    Finding.CHECKSUM_ABSENT: _note(
        "no checksum: The command's checksum is 0, as the EDORAS bridges send it; no cFS app here checks it."
    ),
    Finding.SEQUENCE_UNSET: _note(
        "no sequence: The sequence word is 0x0000, as the EDORAS bridges send it, so a loss leaves no "
        "visible gap."
    ),
    Finding.ENVELOPE_OVERRUN: _error(
        "envelope overrun: buffer_length exceeds the bytes in the packet, so there is no complete message; a"
        " receiver that trusts it reads beyond the data."
    ),
    Finding.STALE_TAIL: _note(
        "stale tail: The bytes after the CDR are not zero: a fixed-size struct still has them from an "
        "earlier, longer message; readers ignore them."
    ),
    Finding.CDR_INVALID: _error(
        "bad CDR: The CDR body does not decode as the configured type; the receiver's rmw_deserialize fails "
        "on it."
    ),
    Finding.UNKNOWN_MSG_ID: _warning(
        "unknown MsgId: No configured topic and no known cFE packet has this MsgId; without a subscriber the"
        " software bus drops it."
    ),
    Finding.SBN_SIZE_MISMATCH: _warning(
        "MsgSz: MsgSz differs from the size of the payload; the receiver ignores that up to 32767 and "
        "refuses larger values."
    ),
    Finding.SBN_UNKNOWN_TYPE: _error(
        "unknown SBN type: MsgType is not an SBN message type; the receiver reports an error and drops the "
        "datagram."
    ),
    Finding.SBN_ID_MISMATCH: _error(
        "SBN identity: Not a known peer: another $Id in SUB or UNSUB, or the SpacecraftID and ProcessorID of"
        " an unknown peer; the receiver refuses it."
    ),
    Finding.OVER_CI_BUFFER: _error(
        "over 768: The packet is longer than CI's 768-byte buffer, by its header too; CI cuts it to 768 and "
        "accepts it silently (cFS 7: drops it)."
    ),
    Finding.OVER_BRIDGE_BUFFER: _warning(
        "over 1024: The datagram is longer than the ground bridge's 1024-byte buffer; the bridge trusts "
        "buffer_length and publishes such a message as garbage."
    ),
    Finding.BRIDGE_DROPS_LENGTH: _warning(
        "length mod 256: The length modulo 256 is below 11; the public flight bridge keeps the length in a "
        "uint8_t and drops the datagram."
    ),
    Finding.HEADER_ONLY: _note(
        "header only: The packet ends after its header: a scheduler's wake-up or a request, not a message."
    ),
    Finding.INVALID_MSG_ID: _error(
        "invalid MsgId: The MsgId is 0 or above 0x1FFF; the software bus refuses it (CFE_SB 21)."
    ),
    Finding.WRONG_DIRECTION: _warning(
        "direction: The MsgId's type bit is wrong for the link: telemetry sent to CI, or a command from TO; "
        "CI accepts it."
    ),
    Finding.UNKNOWN_FUNCTION_CODE: _error(
        "function code: The app has no such function code; it sends an error event and ignores the command."
    ),
    Finding.COMMAND_LENGTH: _error(
        "command length: The command's length is wrong for its function code; apps refuse it with an event, "
        "except TO's enable command, which reads the bytes that exist."
    ),
    Finding.OVER_SOFTWARE_BUS: _error(
        "over 32768: The length field exceeds the software bus's 32768 bytes; the send fails (CFE_SB 15)."
    ),
    Finding.SBN_VERSION_MISMATCH: _error(
        "SBN version: PROTO has a protocol version other than 11; the receiver refuses it."
    ),
    Finding.SBN_NO_MESSAGE: _note("NO_MSG: MsgType is NO_MSG; the receiver ignores it."),
    Finding.SBN_LEGACY_HEADER: _warning(
        "7-byte header: The SBN header has 7 bytes and no SpacecraftID, as in older versions; a current peer"
        " reads the next 4 bytes as one."
    ),
    Finding.CDR_BIG_ENDIAN: _note(
        "big-endian: The CDR is big-endian, which no EDORAS sender on a little-endian machine writes; it is "
        "decoded nevertheless."
    ),
    Finding.FRAGMENT: _note(
        "fragments: A part of a message: an IP fragment, a piece of a TCP stream, one of several WebSocket "
        "frames; the content comes with the frame that completes it, if one does."
    ),
    Finding.STREAM_GAP: _warning(
        "stream gap: Bytes of the stream before this (TCP segments, or transfer frames) are missing in the "
        "capture, or are no message of the link."
    ),
    Finding.STREAM_RESENT: _note(
        "sent again: The TCP segment has bytes that had come before: they were lost on the way, or their "
        "acknowledgement was late."
    ),
    Finding.CAPTURE_CUT: _warning(
        "capture cut: The capture's snap length cut the frame: bytes are missing in the capture, not on the "
        "wire."
    ),
    Finding.STRUCT_LENGTH: _warning(
        "struct length: The payload has another length than the C struct known for this MsgId, so it is not "
        "decoded with it: another build; name its layout with --set structs."
    ),
    Finding.CDR_TRAILING: _note(
        "trailing bytes: A few bytes follow the message's last field: rmw_serialize leaves them, mostly "
        "behind empty sequences; readers ignore them."
    ),
    Finding.CDR_TOO_LONG: _warning(
        "CDR too long: More bytes follow the message's last field than ROS 2 leaves there; receivers ignore "
        "them, but often it is a message of another type."
    ),
}
"""Every finding; :func:`explain` looks one up."""

NOTABLE: Final = Finding(sum(item for item, entry in EXPLANATIONS.items() if entry.severity >= Level.WARNING))
"""Every finding that is more than a note."""

_BY_LABEL: Final = {item.label: item for item in Finding}


def explain(finding: Finding | str) -> Explanation:
    """Return the explanation of one finding.

    Args:
        finding: one bit, or its label as in JSON; an unknown label gives a warning with that explanation.
    """
    if isinstance(finding, str):
        if finding not in _BY_LABEL:
            return Explanation(Level.WARNING, finding, "This version does not know this finding.")
        finding = _BY_LABEL[finding]
    return EXPLANATIONS[finding]


def ranked(findings: Finding, *, at_least: Level = Level.NOTE) -> list[Finding]:
    """Return the bits that are set, the most severe first."""
    explained = [one for one in findings if one in EXPLANATIONS and EXPLANATIONS[one].severity >= at_least]
    return sorted(explained, key=lambda item: -EXPLANATIONS[item].severity)


def worst(findings: Finding) -> Level | None:
    """Return the highest severity among the bits that are set, or None if no bit is set."""
    first = ranked(findings)[:1]
    return EXPLANATIONS[first[0]].severity if first else None
