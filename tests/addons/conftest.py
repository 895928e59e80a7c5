"""The tests here call commands."""

from commands import *  # noqa: F403  fixtures, which pytest looks for here
