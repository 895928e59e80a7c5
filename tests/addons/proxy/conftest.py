"""The tests here call commands, and run proxies."""

from commands import *  # noqa: F403  fixtures, which pytest looks for here
from pipeline_fixtures import arena, as_batch, batches, bench, ends, made_up, row  # noqa: F401
