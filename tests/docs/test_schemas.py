"""The published schemas: each command that names one has it, and all are in the wheel."""

import json

from packaged import installed_packages
from places import ROOT
from toml_files import TOML

FOLDER = ROOT / "docs/schemas"


def test_each_is_read_and_versioned():
    names = {path.name.removesuffix(".schema.json") for path in FOLDER.iterdir()}
    assert names >= {"against", "check", "compare", "doctor", "export", "predict"}
    for name in names:
        schema = json.loads((FOLDER / f"{name}.schema.json").read_text())
        assert "schema" in schema["required"], name
        assert schema["$schema"].startswith("https://json-schema.org/"), name


def test_the_wheel_takes_them():
    packages = installed_packages()
    assert "edoras_tools.schemas" in packages.names
    assert ROOT / packages.folders["edoras_tools.schemas"] == FOLDER
    patterns = TOML.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert {path for item in patterns["edoras_tools.schemas"] for path in FOLDER.glob(item)} == set(
        FOLDER.iterdir()
    )
