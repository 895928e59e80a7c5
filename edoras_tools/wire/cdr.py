"""The CDR encapsulation header (OMG DDSI-RTPS 2.5, 10.2); the bodies are read in ``edoras_tools.ros``."""

from __future__ import annotations

from typing import Final

from edoras_tools.wire.layout import Field, Layout

CDR_BE: Final = 0x0000
CDR_LE: Final = 0x0001
ROUNDED: Final = 3
"""Most bytes that follow a message because RTPS rounds its length up to 4 (DDSI-RTPS 9.4.2.13)."""

ENCAPSULATION: Final = Layout(
    "cdr",
    "CDR",
    Field(
        "representation",
        16,
        "how the body is encoded; alignment counts from the byte after this header",
        names={
            CDR_BE: "CDR big-endian",
            CDR_LE: "CDR little-endian",
            2: "PL_CDR big-endian",
            3: "PL_CDR little-endian",
        },
        base=16,
        clause="RTPS 10.5",
    ),
    Field("options", 16, "unused, 0", base=16),
)
