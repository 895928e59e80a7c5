"""What setup.py installs, as setuptools hears it."""

from __future__ import annotations

import runpy
from types import SimpleNamespace

import pytest
from places import ROOT


def installed_packages() -> SimpleNamespace:
    """The ``names`` of all packages, and the ``folders`` of those that lie beside ``edoras_tools``."""
    heard: dict[str, object] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("setuptools.setup", lambda **keywords: heard.update(keywords))
        runpy.run_path(str(ROOT / "setup.py"))
    return SimpleNamespace(names=heard["packages"], folders=heard["package_dir"])
