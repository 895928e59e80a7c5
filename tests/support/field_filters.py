"""Filters by header fields, held against what the tree shows of each datagram."""

import numpy as np

from edoras_tools.decode.filters.filter import Where


def compared(bench, rows, layouts):
    """Compare ``LAYER.FIELD > 0`` for every number of some headers; return how many datagrams were chosen."""
    found, shown = 0, [bench.dissector.dissect(rows.batch[row]) for row in range(len(rows))]
    for layout in layouts:
        for name in (name for name, slot in layout.by_name.items() if slot.field.kind != "bytes"):
            wanted = [
                row
                for row, decoded in enumerate(shown)
                if (layer := decoded.layer(layout.name)) and layer.values()[name] > 0
            ]
            chosen = Where(f"{layout.name}.{name} > 0", bench.columns.context).passing(rows)
            assert np.flatnonzero(chosen).tolist() == wanted, (layout.name, name)
            found += len(wanted)
    return found
