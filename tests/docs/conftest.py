"""What the tests of the pages share: the scripts beside them, as modules."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess

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


@pytest.fixture(scope="session")
def typed(refresh):
    """A function: what a line that somebody types does; where it is only ``edoras``, no shell is needed."""

    def run(line):
        bare = re.sub(r"'[^']*'|\"[^\"$`\\]*\"", "", line)
        if not line.startswith("edoras ") or re.search(r"[|<>;&$*?~`]", bare):
            return refresh.shell(line)
        ran = warm.run(*shlex.split(line)[1:], stderr=subprocess.STDOUT)
        return ran.returncode, ran.stdout.decode()

    return run
