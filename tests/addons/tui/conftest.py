"""What the tests of the three-pane view share: the view, driven by textual's pilot, without a terminal."""

from __future__ import annotations

import asyncio
import time

import pytest
from places import ROOT
from waiting import PATIENCE_S

from edoras_tools.addons.tui.viewer import Viewer, ViewOptions
from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files

MISSIONS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]


class Hands:
    """A user: presses keys, writes, clicks, and waits until something is so."""

    def __init__(self, app, pilot):
        self.app = app
        self.pilot = pilot

    async def until(self, holds, what=""):
        deadline = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < deadline, f"never came true: {what}"
            await asyncio.sleep(0.005)

    async def rest(self):
        """Wait until every message has been dealt with; the pilot's own pause takes far longer."""
        quiet = 0
        while quiet < 5:
            await asyncio.sleep(0)
            pumps = [self.app, *(pump for screen in self.app.screen_stack for pump in screen.walk_children())]
            busy = any(pump.message_queue_size for pump in (*pumps, *self.app.screen_stack))
            quiet = 0 if busy else quiet + 1

    async def press(self, *keys):
        for key in keys:
            self.app.simulate_key(key)
            await self.rest()

    async def write(self, text):
        self.app.focused.insert_text_at_cursor(text)
        await self.rest()

    async def filter(self, text):
        await self.press("f")
        self.app.filter_line.input.value = ""
        await self.write(text)
        await self.press("enter")

    async def go(self, number):
        await self.press("colon")
        await self.write(str(number))
        await self.press("enter")
        await self.until(lambda: self.number == number, f"packet {number}")

    async def settle(self):
        store = self.app.store
        await self.until(lambda: store.settled == store.packets, "the filter has run")
        await self.rest()

    @property
    def number(self):
        return self.app.decoded.datagram.number if self.app.decoded else 0

    @property
    def status(self):
        return str(self.app._status_left.render())

    def lines(self, widget):
        return [widget.render_line(line).text.rstrip() for line in range(widget.page)]


@pytest.fixture(scope="session")
def drive():
    """A function: run a coroutine with a user's hands on the view of a capture, or of another source."""

    known = Settings(MISSIONS).workbench()

    def run(
        script,
        capture="f_sbn_disconnect",
        *,
        size=(120, 40),
        source=None,
        selection=None,
        options=None,
        **choice,
    ):
        async def whole():
            settings = Settings(MISSIONS, options=options or Options())
            context = Context(known.mission, known.types, settings.options)
            bench = Workbench(known.mission, known.types, ColumnDecoder(context))
            opened = source or open_files([ROOT / f"samples/captures/{capture}.pcap"])
            app = Viewer(opened, bench, ViewOptions(selection or Selection(), settings, **choice))
            async with app.run_test(size=size) as pilot:
                hands = Hands(app, pilot)
                if source is None:
                    await hands.until(lambda: not app.reading, "the file is read")
                await pilot.pause()
                await script(hands)
            app._feed.join(PATIENCE_S)
            app._filter_thread.join(PATIENCE_S)
            assert not app._feed.is_alive()
            assert not app._filter_thread.is_alive()

        asyncio.run(whole())

    return run
