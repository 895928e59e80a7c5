"""The tests here write made-up batches."""

from sink_fixtures import *  # noqa: F403  fixtures, which pytest looks for here
