"""``edoras`` in this process, as the installed command runs it: only the command that is named is made."""

import sys

from edoras_tools.cli import main


def edoras():
    """Run what ``sys.argv`` says, to its ``SystemExit``."""
    sys.argv[1:] = main.with_command(sys.argv[1:])
    main.run(main.program(*(word for word in sys.argv[1:2] if main.is_command(word))))
