from __future__ import annotations

import re

from places import ROOT

GUIDE = (ROOT / "docs/sim.md").read_text()


def test_the_guide_s_example_prints_what_the_guide_says(capsys):
    code, output = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", GUIDE, re.DOTALL).groups()
    exec(compile(code, "docs/sim.md", "exec"), {})
    assert capsys.readouterr().out == output
