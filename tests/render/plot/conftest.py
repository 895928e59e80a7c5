"""The tests here draw one plot."""

from plotted import *  # noqa: F403  fixtures, which pytest looks for here
