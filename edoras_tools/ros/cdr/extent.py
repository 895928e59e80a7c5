"""Finds the end of a message: follows counts and lengths, and reads no values."""

from __future__ import annotations

import struct
from typing import Final

from edoras_tools.errors import WireError
from edoras_tools.ros.cdr.plan import CdrPlan, PrimitiveRun, Text
from edoras_tools.ros.cdr.reader import ENCAPSULATION_BYTES, encapsulation_order

_COUNTS: Final = struct.Struct("<I"), struct.Struct(">I")


def extent(name: str, plan: CdrPlan, cdr: bytes) -> int:
    """Return the bytes of a message with its encapsulation, without what follows the last field.

    Raises:
        WireError: the message ends before its last field does, or is not CDR.
    """
    count = _COUNTS[encapsulation_order(name, cdr)]
    try:
        end = ENCAPSULATION_BYTES + _end(plan, count, memoryview(cdr)[ENCAPSULATION_BYTES:], 0)
    except struct.error:
        end = len(cdr) + 1
    if end > len(cdr):
        raise WireError(f"{name}: the message ends at byte {len(cdr)}, before its last field does")
    return end


def _end(plan: CdrPlan, count: struct.Struct, body: memoryview, position: int) -> int:
    """Return where a plan that starts at a position ends, which may lie behind the body.

    Raises:
        struct.error: a count or a length lies behind the body.
    """
    for step in plan.steps:
        if isinstance(step, PrimitiveRun):
            position = ((position + step.alignment - 1) & -step.alignment) + step.size
            continue
        times = None if isinstance(step, Text) else step.count
        if times is None:
            position = (position + 3) & -4
            (times,) = count.unpack_from(body, position)
            position += 4
        if isinstance(step, Text):
            position += times * step.width
        elif times and (run := step.plan.uniform):
            position = ((position + run.alignment - 1) & -run.alignment) + times * run.size
        else:
            for _ in range(times):
                position = _end(step.plan, count, body, position)
                if position > len(body):  # a wrong count does not make this loop long
                    return position
    return position
