"""A plot as a page: its data, read as a browser reads them."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest

from edoras_tools.render.plot.page import plot_page


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
