"""The published schemas: each command that names one has it, and all are in the wheel."""

import json

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
    tool = TOML.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "edoras_tools.schemas" in tool["packages"]
    assert ROOT / tool["package-dir"]["edoras_tools.schemas"] == FOLDER
    patterns = tool["package-data"]["edoras_tools.schemas"]
    assert {path for item in patterns for path in FOLDER.glob(item)} == set(FOLDER.iterdir())
