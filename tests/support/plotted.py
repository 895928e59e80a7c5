"""A plot with all that there is: two recordings, a long line, rates, events, names that could do harm."""

import numpy as np
import pytest

from edoras_tools.render.plot.figure import EventMark, Figure, Panel, PlotLine


@pytest.fixture(scope="session")
def figure():
    seconds = np.linspace(0, 10, 5000)
    wave = np.sin(seconds)
    wave[2500] = 7.0
    return Figure(
        ["good.mcap", "<bad>&\x1b[31m.mcap"],
        [
            Panel(
                "/cmd_vel.linear.*",
                [
                    PlotLine("x · good", 0, seconds, wave, 5000),
                    PlotLine("x · bad", 1, np.array([1.0, 9.0]), np.array([0.0, 1.0]), 2, 3),
                    PlotLine("nothing", 0, np.zeros(0), np.zeros(0), 0, 4, colour=1),
                ],
            ),
            Panel(
                "rates",
                [PlotLine("/cmd_vel", 0, seconds[:50], np.arange(50.0), 50)],
                "messages/s",
                beneath=True,
            ),
        ],
        (0.0, 10.0),
        [EventMark(2.0, 0, False, "ES: ready"), EventMark(5.0, 1, True, "</script><b>")],
        3,
        ["a note"],
    )
