"""Makes debug information for structs from their C headers, with the C compiler of this machine."""

from __future__ import annotations

import os
import shlex
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.structs.debug_info.dwarf import DebugInfo

if TYPE_CHECKING:
    from collections.abc import Sequence

_CLASSES: Final = frozenset({".hh", ".hpp", ".hxx", ".cc", ".cpp", ".cxx"})
SOURCE_SUFFIXES: Final = frozenset({".h", ".c"}) | _CLASSES
"""File suffixes of C and C++ headers and sources."""
_UNIT: Final = "typedef char edoras_unit;\n"
"""Compiled after the header, so that a header without types also has debug information."""
_PATIENCE_S: Final = 120


def compiled(source: Path, include: Sequence[Path], flags: Sequence[str]) -> DebugInfo:
    """Compile a header for its debug information alone: every type in it, used or not.

    The compiler is ``$CC`` with its options, or ``cc``; a cross compiler gives the sizes and byte order of
    its target.

    Args:
        source: the header, or a source that includes some.
        include: where the headers that it includes are.
        flags: further options, as ``-m32`` or ``-DX=1``.

    Raises:
        ConfigError: there is no compiler, or it fails; with the first line of its output.
    """
    try:
        compiler = shlex.split(os.environ.get("CC", "cc")) or ["cc"]
    except ValueError as error:
        raise ConfigError(f"CC: {os.environ['CC']!r} is not a command: {error}") from error
    if not source.is_file():
        raise ConfigError(f"{source}: no such file; give a C header, or an ELF file")
    with tempfile.TemporaryDirectory(prefix="edoras-") as folder:
        unit = Path(folder, "structs.cc" if source.suffix.lower() in _CLASSES else "structs.c")
        unit.write_text(_UNIT, encoding="utf-8")
        target = Path(folder, "structs.o")
        command = [*compiler, "-g", "-gdwarf-4", "-fno-eliminate-unused-debug-types", *flags]
        command += [*(f"-I{path}" for path in include), "-include", str(source.resolve())]
        try:
            result = subprocess.run(  # noqa: S603  the user's own compiler, with the user's own options
                [*command, "-c", str(unit), "-o", str(target)],
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=_PATIENCE_S,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            why = getattr(error, "strerror", None) or "takes too long"
            raise ConfigError(
                f"{compiler[0]}: {why}; install a C compiler or name one in CC, or give an ELF file"
            ) from error
        if result.returncode:
            errors = [
                line for line in result.stderr.splitlines() if "error" in line
            ] or result.stderr.splitlines()
            raise ConfigError(
                f"{source}: does not compile: {errors[0].strip() if errors else 'no word from the compiler'}"
            )
        if not target.exists():
            raise ConfigError(f"{source}: the compiler makes no object file; look at --cflag and CC")
        return DebugInfo(target, source)
