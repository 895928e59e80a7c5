"""What each finding means, and how much it matters."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from edoras_tools.model import Finding


class Severity(IntEnum):
    """How much a finding matters to whoever sent the datagram."""

    NOTE = 1
    """Usual with these senders; nothing is lost by it."""
    WARNING = 2
    """Odd, or lost at some receivers only."""
    ERROR = 3
    """Refused, lost or garbled, or not readable at all."""

    @property
    def label(self) -> str:
        """``note``, ``warning`` or ``error``."""
        return self.name.lower()

    @property
    def style(self) -> str:
        """The rich style of this severity, the same in every view."""
        return ("", "blue", "yellow", "bold red")[self]

    @property
    def mark(self) -> str:
        """One character that tells the severity without colour."""
        return (" ", "·", "!", "✗")[self]


@dataclass(frozen=True, slots=True)
class Explanation:
    """What people are told of a finding.

    Attributes:
        severity: how much it matters.
        short: two or three words, for the packet list.
        meaning: one sentence: what it is, and what the receiver does with it.
    """

    severity: Severity
    short: str
    meaning: str


_NOTE, _WARNING, _ERROR = Severity.NOTE, Severity.WARNING, Severity.ERROR

EXPLANATIONS: Final = {
    Finding.TRUNCATED: Explanation(
        _ERROR,
        "truncated",
        "A layer needs more bytes than the datagram holds; CI drops commands below 8 bytes, and an app "
        "that gets a cut one fails to read it or reads what its buffer held before.",
    ),
    Finding.LENGTH_MISMATCH: Explanation(
        _WARNING,
        "length field",
        "The packet data length field disagrees with the bytes that came; CI accepts that silently.",
    ),
    Finding.CHECKSUM_BAD: Explanation(
        _WARNING,
        "checksum",
        "The command's checksum is neither 0 nor right; no cFS app here checks it, so the command is obeyed.",
    ),
    Finding.CHECKSUM_ABSENT: Explanation(
        _NOTE,
        "no checksum",
        "The command's checksum is 0, as the EDORAS bridges send it; no cFS app here checks it.",
    ),
    Finding.SEQUENCE_UNSET: Explanation(
        _NOTE,
        "no sequence",
        "The sequence word is 0x0000, as the EDORAS bridges send it, so a loss leaves no gap to see.",
    ),
    Finding.ENVELOPE_OVERRUN: Explanation(
        _ERROR,
        "envelope overrun",
        "buffer_length reaches past the end of the packet, so there is no whole message; a receiver that "
        "trusts it reads beyond the data.",
    ),
    Finding.STALE_TAIL: Explanation(
        _NOTE,
        "stale tail",
        "The bytes after the CDR are not zero: a fixed-size struct kept them of an earlier, longer "
        "message; readers ignore them.",
    ),
    Finding.CDR_INVALID: Explanation(
        _ERROR,
        "bad CDR",
        "The CDR body does not decode as the configured type; the receiver's rmw_deserialize fails on it.",
    ),
    Finding.UNKNOWN_MSG_ID: Explanation(
        _WARNING,
        "unknown MsgId",
        "No configured topic and no known cFE packet has this MsgId; without a subscriber the software "
        "bus drops it.",
    ),
    Finding.SBN_SIZE_MISMATCH: Explanation(
        _WARNING,
        "MsgSz",
        "MsgSz is not the size of the payload that came; the receiver ignores that up to 32767 and "
        "refuses more.",
    ),
    Finding.SBN_UNKNOWN_TYPE: Explanation(
        _ERROR,
        "unknown SBN type",
        "MsgType is none of SBN's; the receiver reports an error and drops the datagram.",
    ),
    Finding.SBN_ID_MISMATCH: Explanation(
        _ERROR,
        "SBN identity",
        "Not the peer that is known here: another $Id in SUB or UNSUB, or SpacecraftID and ProcessorID of "
        "an unknown peer; the receiver refuses it.",
    ),
    Finding.OVER_CI_BUFFER: Explanation(
        _ERROR,
        "over 768",
        "The datagram is longer than CI's 768-byte buffer; CI cuts it to 768 and accepts it silently.",
    ),
    Finding.OVER_BRIDGE_BUFFER: Explanation(
        _WARNING,
        "over 1024",
        "The datagram is longer than the ground bridge's 1024-byte buffer; the bridge trusts "
        "buffer_length and publishes such a message as garbage.",
    ),
    Finding.BRIDGE_DROPS_LENGTH: Explanation(
        _WARNING,
        "length mod 256",
        "The length modulo 256 is below 11; the public flight bridge keeps the length in a uint8_t and "
        "drops the datagram.",
    ),
    Finding.HEADER_ONLY: Explanation(
        _NOTE,
        "header only",
        "The packet ends with its header: a scheduler's wake-up or a request, not a message.",
    ),
    Finding.INVALID_MSG_ID: Explanation(
        _ERROR,
        "invalid MsgId",
        "The MsgId is 0 or above 0x1FFF; the software bus refuses it (CFE_SB 21).",
    ),
    Finding.WRONG_DIRECTION: Explanation(
        _WARNING,
        "direction",
        "The MsgId's type bit does not suit the link: telemetry sent to CI, or a command from TO; CI "
        "accepts it.",
    ),
    Finding.UNKNOWN_FUNCTION_CODE: Explanation(
        _ERROR,
        "function code",
        "The app has no such function code; it sends an error event and ignores the command.",
    ),
    Finding.COMMAND_LENGTH: Explanation(
        _ERROR,
        "command length",
        "The command's length is not what its function code takes; apps refuse it with an event, all but "
        "TO's enable, which reads what is there.",
    ),
    Finding.OVER_SOFTWARE_BUS: Explanation(
        _ERROR,
        "over 32768",
        "The length field exceeds the software bus's 32768 bytes; the send fails (CFE_SB 15).",
    ),
    Finding.SBN_VERSION_MISMATCH: Explanation(
        _ERROR,
        "SBN version",
        "PROTO names another protocol version than 11; the receiver refuses it.",
    ),
    Finding.SBN_NO_MESSAGE: Explanation(
        _NOTE,
        "NO_MSG",
        "MsgType is NO_MSG; the receiver ignores it.",
    ),
    Finding.SBN_LEGACY_HEADER: Explanation(
        _WARNING,
        "7-byte header",
        "The SBN header has 7 bytes and no SpacecraftID, as older sources write it; a current peer takes "
        "the next 4 bytes for one.",
    ),
    Finding.CDR_BIG_ENDIAN: Explanation(
        _NOTE,
        "big-endian",
        "The CDR is big-endian, which no EDORAS sender on a little-endian machine writes; it is decoded "
        "all the same.",
    ),
    Finding.FRAGMENT: Explanation(
        _NOTE,
        "fragments",
        "The datagram came in IP fragments and was put together from several frames.",
    ),
    Finding.CAPTURE_CUT: Explanation(
        _WARNING,
        "capture cut",
        "The capture's snap length cut the frame: the bytes are missing here, not on the wire.",
    ),
    Finding.STRUCT_LENGTH: Explanation(
        _WARNING,
        "struct length",
        "The payload is not as long as the C struct that is known for this MsgId, so it is not read by it: "
        "another build; --structs names its own layout.",
    ),
}
"""Every finding; :func:`explain` looks one up."""

NOTABLE: Final = Finding(
    sum(item for item, told in EXPLANATIONS.items() if told.severity >= Severity.WARNING)
)
"""Every finding that is more than a note."""

_BY_LABEL: Final = {item.label: item for item in Finding}


def explain(finding: Finding | str) -> Explanation:
    """Return what people are told of one finding.

    Args:
        finding: one bit, or its label as in JSON; a label that is not known is a warning that says so.
    """
    if isinstance(finding, str):
        if finding not in _BY_LABEL:
            return Explanation(_WARNING, finding, "This version does not know the finding.")
        finding = _BY_LABEL[finding]
    return EXPLANATIONS[finding]


def ranked(findings: Finding, *, at_least: Severity = Severity.NOTE) -> list[Finding]:
    """Return the bits that are set, the gravest first."""
    known = [item for item in findings if item in EXPLANATIONS and EXPLANATIONS[item].severity >= at_least]
    return sorted(known, key=lambda item: -EXPLANATIONS[item].severity)


def worst(findings: Finding) -> Severity | None:
    """Return the gravest severity among the bits that are set, or None where there are none."""
    first = ranked(findings)[:1]
    return EXPLANATIONS[first[0]].severity if first else None
