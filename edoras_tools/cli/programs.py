"""The entry points of the programs, which make start and end fast."""

import _signal as signal  # type: ignore[import-not-found]  # no file: it is there at once

_HEEDED = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _HEEDED:  # set first: Ctrl-C while Python still loads modules ends the program without a message
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import gc  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
from contextlib import suppress  # noqa: E402
from functools import partial  # noqa: E402
from typing import Final, NoReturn  # noqa: E402

_TURN_S: Final = 50e-6
"""A thread that released Python's global lock in numpy gets it back after this time, not after 5 ms."""


def _start(alone: str = "") -> NoReturn:
    """Run ``edoras``, or a program with one command.

    Start-up creates hardly any garbage, nothing has to be cleaned up at the end, and numpy's linear algebra,
    which is not used here, need not start threads.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(200_000)
    sys.setswitchinterval(_TURN_S)
    try:
        from edoras_tools.cli import main, output

        line = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
        completes = "_EDORAS_COMPLETE" in os.environ
        if not alone and not completes:
            sys.argv[1:] = main.with_command(sys.argv[1:])
        names = [item for item in (line.split() if completes else sys.argv)[1:2] if main.is_command(item)]
        if sys.argv[1:] == ["--version"]:
            names = ["help"]  # to make all commands takes most of the time
        app = main.alone(alone) if alone else main.program(*names, completes=completes)
    except ModuleNotFoundError:
        raise
    except (OSError, MemoryError, ImportError) as error:  # too many open files, or no memory
        sys.stderr.write(f"edoras: cannot start: {str(error) or 'out of memory'}\n")
        os._exit(1)
    try:
        if _HEEDED:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            main.run(app)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
            with suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
    except KeyboardInterrupt:
        code = output.INTERRUPTED
    os._exit(code)


def main() -> NoReturn:
    """Run ``edoras``."""
    _start()


sniff: Final = partial(_start, "sniff")
"""Run ``edoras-sniff``."""
record: Final = partial(_start, "record")
"""Run ``edoras-record``."""
replay: Final = partial(_start, "replay")
"""Run ``edoras-replay``."""
proxy: Final = partial(_start, "proxy")
"""Run ``edoras-proxy``."""
