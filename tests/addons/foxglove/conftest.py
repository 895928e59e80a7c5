"""The tests here read made-up batches."""

from pipeline_fixtures import *  # noqa: F403  fixtures, which pytest looks for here
