"""Where things lie in the checkout, for every test however deep its folder."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "samples"
CAPTURES = SAMPLES / "captures"
MISSIONS = SAMPLES / "missions"
SUPPORT = ROOT / "tests" / "support"
