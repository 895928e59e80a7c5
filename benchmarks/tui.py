"""The three-pane view over many packets: how soon all can be reached, how long a frame and a filter take.

A frame is from the key until a line of another page is on the screen; textual draws at most 60 a second.
"""

from __future__ import annotations

import asyncio
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from paths import MISSIONS, captured

SIZE = (160, 50)
FRAMES = 100
FILTERS = ("link == ci and msg_id in 0x1800..0x18ff", "linear.x > 0.1 and linear.y == 0")
ROUNDS = 3


def measure(folder: Path, packets: int) -> dict[str, object]:
    """Open a capture in a process of its own, as a user would; the best of three."""
    capture = captured(folder, packets)
    found = []
    for _ in range(ROUNDS):
        began = time.time()
        child = subprocess.run(
            [sys.executable, __file__, capture, str(packets), repr(began)],
            check=True,
            capture_output=True,
            text=True,
        )
        found.append(json.loads(child.stdout.splitlines()[-1]))
    return {"packets": packets} | {key: min(item[key] for item in found) for key in found[0]}


async def look(capture: Path, packets: int, began: float) -> dict[str, object]:
    """Drive the view without a terminal; times count from the start of the process."""
    from edoras_tools.addons.tui.panes import ViewOptions
    from edoras_tools.addons.tui.viewer import Viewer
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, open_files

    settings = Settings(MISSIONS)
    app = Viewer(open_files([capture]), settings.workbench(), ViewOptions(Selection(), settings))
    report: dict[str, object] = {}
    async with app.run_test(size=SIZE) as pilot:
        while len(app.store) < SIZE[1]:  # noqa: ASYNC110  looked at from outside
            await asyncio.sleep(0.001)
        report["first_page_s"] = round(time.time() - began, 2)
        while len(app.store) < packets:  # noqa: ASYNC110  looked at from outside
            await asyncio.sleep(0.001)
        report["last_row_s"] = round(time.time() - began, 2)
        report["last_row_cpu_s"] = round(time.process_time(), 2)
        await pilot.press("G")
        assert app.decoded.datagram.number == packets
        frames, lines = [], []
        for frame in range(FRAMES):
            # Pages that were never in sight, so that every line is dissected and drawn.
            start, row = time.perf_counter(), (frame * 7919 * SIZE[1]) % packets
            app.packets.go(row)
            while (row + 1, 0) not in app.packets.drawn:  # noqa: ASYNC110
                await asyncio.sleep(0)
            frames.append(time.perf_counter() - start)
            app.packets.drawn.clear()
            start = time.perf_counter()
            for line in range(app.packets.page):
                app.packets.render_line(line)
            lines.append(time.perf_counter() - start)
        report["frame_ms"] = round(1e3 * sorted(frames)[FRAMES // 2], 1)
        report["slow_frame_ms"] = round(1e3 * sorted(frames)[FRAMES * 95 // 100], 1)
        report["lines_of_it_ms"] = round(1e3 * sorted(lines)[FRAMES // 2], 1)
        for place, text in enumerate(FILTERS):
            start = time.perf_counter()
            app.filter_line.accept(text, app.store.begin_ns)
            await asyncio.sleep(0)
            while app.store.settled < packets or not app.store.filtered:  # noqa: ASYNC110  looked at from outside
                await asyncio.sleep(0.001)
            report[f"filter_{('headers', 'message')[place]}_s"] = round(time.perf_counter() - start, 3)
            app.store.filtered = False
    report["peak_memory_mib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return report


if __name__ == "__main__":
    print(json.dumps(asyncio.run(look(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))))
