"""A plot as a page: its data, read as a browser reads them."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from effort import long_but

from edoras_tools.addons.plot.page import plot_page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.texts, self.addresses, self._inside = {}, [], ""

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [value for name, value in attributes if name in {"src", "href"}]
        self._inside = values.get("type") or tag

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        self.texts[self._inside] = self.texts.get(self._inside, "") + data


@pytest.fixture(scope="module")
def read(figure):
    reader = Reader()
    reader.feed(plot_page(figure))
    return reader


def test_the_data_are_those_of_the_plot(figure, read):
    data = json.loads(read.texts["application/json"])
    assert data["span"] == [0, 10]
    assert [panel["heading"] for panel in data["panels"]] == ["/cmd_vel.linear.*", "rates, messages/s"]
    whole = figure.panels[0].lines[0]
    line = data["panels"][0]["lines"][0]
    np.testing.assert_allclose(line["t"], whole.seconds, atol=1e-6)
    np.testing.assert_allclose(line["v"], whole.values, rtol=1e-8)
    assert data["marks"] == [[2.0, 0, False, "ES: ready"], [5.0, 1, True, "</script><b>"]]


def test_it_loads_nothing_and_names_do_no_harm(figure, read):
    assert read.addresses == []
    text = plot_page(figure)
    assert "<b>" not in text
    assert "<bad>" not in text
    assert "\x1b" not in text
    assert text.count("<script") == 2
    assert "prefers-color-scheme: dark" in text
    assert "fetch(" not in text


HAND = """<script>addEventListener('load', () => {
  SVGElement.prototype.setPointerCapture = () => {};
  const svg = document.querySelector('#plot > svg'), seen = {views: [], kept: 0};
  const left = svg.getBoundingClientRect().left + LEFT, room = across(svg.clientWidth);
  const at = (share) => ({clientX: left + share * room});
  for (const [from, to] of [[0.2, 0.6], [0.75, 0.25], [0.5, 0.501]]) {
    svg.dispatchEvent(new PointerEvent('pointerdown', at(from)));
    seen.kept += svg.dispatchEvent(new MouseEvent('mousedown', {...at(from), cancelable: true}));
    svg.dispatchEvent(new PointerEvent('pointermove', at(to)));
    svg.dispatchEvent(new PointerEvent('pointerup', at(to)));
    seen.views.push(view.map((value) => Number(value.toFixed(3))));
  }
  seen.cursors = [...document.querySelectorAll('.cursor')].map((item) => item.getAttribute('x1'));
  document.querySelector('.legend button').click();
  seen.hidden = document.querySelector('.legend button').getAttribute('aria-pressed');
  svg.dispatchEvent(new MouseEvent('dblclick'));
  seen.views.push(view);
  seen.over = document.documentElement.scrollWidth > innerWidth;
  const letter = (item) => parseFloat(getComputedStyle(item).fontSize);
  seen.letter = Math.min(...[...document.querySelectorAll('svg text')].map(letter));
  document.title = JSON.stringify(seen);
})</script></body>"""


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
@pytest.mark.parametrize("width", long_but([400], [400, 1280]))
def test_dragging_zooms_again_and_again(width, figure, tmp_path):
    path = tmp_path / "plot.html"
    path.write_text(plot_page(figure).replace("</body>", HAND), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900", "--dump-dom"]
    options += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    done = subprocess.run(
        [CHROMIUM, *options, path.as_uri()], capture_output=True, text=True, timeout=300, check=False
    )
    seen = json.loads(re.search(r"<title>(\{.*?\})</title>", done.stdout)[1])
    pixels = pytest.approx(np.array([[2, 6], [3, 5], [3, 5], [0, 10]]), abs=0.05)
    assert np.array(seen["views"]) == pixels, "a click is no zoom, two clicks show all"
    assert seen["kept"] == 0, "the browser may not select text, which it would drag next time"
    assert len(set(seen["cursors"])) == 1
    assert len(seen["cursors"]) == 4, "two panels, and the events of two recordings"
    assert seen["hidden"] == "false"
    assert not seen["over"]
    assert seen["letter"] >= 11
