"""Draws the picture of the page of ``edoras live``: a recording, played, as Chromium shows it.

python docs/make_page_picture.py [OUTPUT [WIDTH [light | dark]]]
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from edoras_tools.addons.foxglove.player import PlaybackOptions, RecordingPlayer, attach, open_recording
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings

SAMPLES: Final = Path(__file__).resolve().parents[1] / "samples"
PICTURE: Final = Path(__file__).parent / "pictures/live_page.png"
_SPEED: Final = 4.0
_ENOUGH: Final = 1_200
"""Datagrams that the doctor has judged in the picture, at least."""


def draw(path: Path, width: int, theme: str) -> None:
    """Play a recording, and take a picture of the page once most of it is judged."""
    settings = Settings((SAMPLES / "missions/rover_ground.yaml",))
    info, bench, reopen = open_recording([SAMPLES / "captures/a_rover.pcap"], settings)
    options = PlaybackOptions(speed=_SPEED, wait=False, loop=True)
    player = RecordingPlayer(reopen, bench, clock=time.monotonic_ns, options=options)
    sink = attach(
        bench, replace(info, name=Path(info.name).name), listen=Endpoint("127.0.0.1", 0), player=player
    )
    thread = threading.Thread(target=player.run, args=(sink,))
    thread.start()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    colour = 0 if theme == "dark" else 1
    browser = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--screenshot={path}")
    page = (f"--blink-settings=preferredColorScheme={colour}", f"--window-size={width},860")
    try:
        while ((sink.server.link_state() or {}).get("doctor") or {"datagrams": 0})["datagrams"] < _ENOUGH:
            time.sleep(1)
        subprocess.run(  # noqa: S603  the system's browser
            [chromium, *browser, *page, "--virtual-time-budget=20000", sink.server.page_url],
            check=True,
            capture_output=True,
        )
    finally:
        player.stop()
        thread.join()


if __name__ == "__main__":
    given = sys.argv[1:]
    draw(
        Path(given[0]) if given else PICTURE,
        int(given[1]) if given[1:] else 1000,
        (given[2:] or ["light"])[0],
    )
