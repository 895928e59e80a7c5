"""The generator: a small cFS app that publishes on command, so that ``edoras sweep`` can measure any cFS."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from edoras_tools.addons.codegen.layout import MARK, banner, guarded
from edoras_tools.errors import ConfigError

STARTUP: Final = "CFE_APP, edoras_gen, EDORAS_GEN_Main, EDORAS_GEN, 80, 32768, 0x0, 0;"
"""Line of ``cfe_es_startup.scr`` that starts the app."""
_SOURCES: Final = Path(__file__).parent / "generator_app"
_MSGIDS: Final = "fsw/inc/edoras_gen_msgids.h"


def generator_app(msg_id: int) -> dict[str, str]:
    """Return the text of each file of the app by its name.

    Raises:
        ConfigError: the MsgId is not one of a command.
    """
    if not 0x1800 <= msg_id <= 0x1FFF:
        raise ConfigError(f"--generator 0x{msg_id:04x}: a command's MsgId is from 0x1800 to 0x1fff")
    command = f"edoras codegen generator --generator 0x{msg_id:04X}"
    head = banner(command, f"Its line in cfe_es_startup.scr:\n\n    {STARTUP}")
    cmake = (_SOURCES / "CMakeLists.txt").read_text(encoding="utf-8")
    defined = f"#define EDORAS_GEN_CMD_MID 0x{msg_id:04X} /**< obeyed: function codes 0 and 2 */\n"
    return {
        "CMakeLists.txt": f"# {MARK}: {command}\n{cmake}",
        "fsw/src/edoras_gen.c": head + (_SOURCES / "edoras_gen.c").read_text(encoding="utf-8"),
        _MSGIDS: banner(command) + guarded("edoras_gen_msgids.h", defined),
    }
