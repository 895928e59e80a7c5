"""Filters over decoded columns: packets per second, by what has to be read for them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from paths import MISSIONS, captured

from edoras_tools.decode.filters.filter import Where
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from pathlib import Path

ROUNDS = 3
FILTERS = {
    "columns": "link == ci and msg_id in 0x1800..0x18ff",
    "headers": "ccsds.apid == 0x27 or cfe_telemetry.seconds > 1001000",
    "sbn_header": "sbn.spacecraft_id == 66",
    "endpoints": "source == 127.0.0.1:2234",
    "findings": "findings contains checksum_absent",
    "message": "linear.x > 0.1 and linear.y == 0",
    "mixed": "msg_id == 0x827 and pose.position.x > 1",
}


def measure(folder: Path, packets: int) -> dict[str, object]:
    """Evaluate each filter on a capture that is decoded already."""
    capture = captured(folder, packets)
    bench = Settings(MISSIONS).workbench()
    decoded = [(batch, bench.columns.decode(batch)) for batch in open_file(capture).batches()]
    rates: dict[str, object] = {}
    for name, text in FILTERS.items():
        best = float("inf")
        for _ in range(ROUNDS):
            where = Where(text, bench.columns.context)
            began = time.perf_counter()
            passed = sum(int(where.mask(batch, columns).sum()) for batch, columns in decoded)
            best = min(best, time.perf_counter() - began)
        rates[name] = {"filter": text, "packets_per_s": round(packets / best), "passed": passed}
    return rates
