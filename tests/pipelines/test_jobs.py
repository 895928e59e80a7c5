"""How many processes share the work on a file."""

import os
import sys

import pytest

from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines import jobs as module
from edoras_tools.pipelines.jobs import jobs_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere")
LARGE = 32 << 20


class _File:
    def __init__(self, size):
        self.statistics = SourceStatistics(total_bytes=size)


@pytest.mark.parametrize(
    ("size", "asked", "cores", "spare", "now", "ever"),
    [
        (LARGE, 0, 2, [1], 2, 2),
        (LARGE, 0, 2, [0, 0, 0, 0, 0], 1, 2),
        (LARGE, 0, 2, [-3, -1, 0, 1], 2, 2),  # something short ran at first
        (LARGE, 0, 8, [7], 3, 3),
        (LARGE, 0, 8, [0, 1, 0, 1, 1], 2, 3),
        (LARGE, 0, 1, [], 1, 1),
        (LARGE, 1, 2, [], 1, 1),
        (LARGE, 4, 2, [], 4, 4),  # what is asked for is done
        (LARGE - 1, 4, 2, [], 1, 1),
        (0, 0, 2, [], 1, 1),
    ],
)
def test_free_processors_are_shared(monkeypatch, size, asked, cores, spare, now, ever):
    left = iter(spare)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(module, "spare_processors", lambda: next(left))
    assert jobs_for(_File(size), asked) == now
    assert not [*left]
    assert jobs_for(_File(size), asked, fixed=False) == ever
