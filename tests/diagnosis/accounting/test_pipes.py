"""Which traffic a count is of, if the capture does not show what comes out of its pipe."""

from __future__ import annotations

import numpy as np
import pytest
from places import ROOT

from edoras_tools.cfs import command_ingest
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI, TO
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire import cfe

COUNTERS = cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, command_ingest.HOUSEKEEPING_MSG_ID


def proven_of_commands(name):
    """Return command MsgId to its proven losses in a capture that shows commands and counters alone."""
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    for batch in open_file(ROOT / f"tests/captures/{name}.pcap.zst").batches():
        columns = bench.columns.decode(batch)
        inside = (columns.link == CI) | ((columns.link == TO) & np.isin(columns.msg_id, COUNTERS))
        part = batch.take(np.flatnonzero(inside))
        examination.add(part, bench.columns.decode(part))
    proven = {}
    for row in examination.diagnose().balance:
        if row.link == CI.label:
            proven[row.msg_id] = proven.get(row.msg_id, 0) + row.proven
    return proven


@pytest.mark.parametrize(
    ("name", "msg_id", "most"),
    [
        ("cfs7/two_robots", 0x1828, 95),
        ("flights/lower_limit_amid", 0x1827, 76),
        ("flights/three_operators", 0x1827, 81),
        ("flights/stood_still", 0x1827, 15),
    ],
)
def test_commands_alone_do_not_own_more_counts_than_their_pipe_can_have_lost(name, msg_id, most):
    """Telemetry that is not captured raised the same counters."""
    assert proven_of_commands(name)[msg_id] <= most
