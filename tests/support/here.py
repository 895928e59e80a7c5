"""``edoras`` in this process, as the installed command runs it: only the command that is named is made.

To make a command takes longer than many a command runs, so each is made once: running changes nothing of it.
"""

import sys
from functools import cache

from typer.main import get_command

from edoras_tools.cli import main


class Made:
    """A program that is called as Typer's own, but keeps what Typer would make of it at each call."""

    def __init__(self, *names):
        program = main.program(*names)
        self.info, self._command = program.info, get_command(program)

    def __call__(self, **options):
        return self._command(**options)


@cache
def _made(name, _function):
    return Made(name)


def edoras():
    """Run what ``sys.argv`` says, to its ``SystemExit``."""
    sys.argv[1:] = main.with_command(sys.argv[1:])
    name = "".join(sys.argv[1:2])
    if name in main.COMMANDS:
        made = _made(name, main._command(name))  # anew where a test has put another function in its place
    else:
        made = Made(*([name] if main.is_command(name) else ()))
    main.run(made)
