"""What the tests of the pages share: the scripts beside them, as modules."""

from __future__ import annotations

import importlib.util
import re
import shlex

import pytest
import warm
from places import ROOT


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def refresh():
    return script("refresh")


@pytest.fixture(scope="session")
def make_pictures():
    return script("make_pictures")


@pytest.fixture(scope="session")
def make_house():
    return script("make_house")


@pytest.fixture(scope="module")
def typed(refresh):
    """A function: what a line that somebody types does; where it is only ``edoras``, no shell is needed."""
    with warm.server() as run:
        yield (
            lambda line: (
                run(shlex.split(line))
                if line.startswith("edoras ") and not re.search(r"[|<>;&$*?~`]", line)
                else refresh.shell(line)
            )
        )
