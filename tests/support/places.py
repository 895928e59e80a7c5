"""Where things lie in the checkout, for every test however deep its folder."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "samples"
CAPTURES = SAMPLES / "captures"
MISSIONS = SAMPLES / "missions"
SUPPORT = ROOT / "tests" / "support"
SAMPLE_MISSIONS = {
    "a_rover": ("rover_ground",),
    "b_arm_single": ("single_arm_ground",),
    "c1_tlm_rate_limit4": ("rover_ground",),
    "d3_cpu1_cpu2": ("two_rovers_ground", "two_rovers_flight"),
    "e_ci_errors": ("rover_ground",),
    "f_sbn_disconnect": ("two_rovers_ground", "two_rovers_flight"),
}
"""The sample captures, each with its missions."""
SMALL_SAMPLES = [name for name in SAMPLE_MISSIONS if name not in {"c1_tlm_rate_limit4", "d3_cpu1_cpu2"}]
"""The two others have missions that these have too, and many times the packets."""
