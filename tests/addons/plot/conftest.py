"""The tests here call commands, and draw one plot."""

from commands import *  # noqa: F403  fixtures, which pytest looks for here
from plotted import *  # noqa: F403
