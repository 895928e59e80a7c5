"""Figures of a run as Prometheus's own client reads them."""

import threading
import urllib.error
import urllib.request
from contextlib import nullcontext

import pytest
from places import CAPTURES, MISSIONS

from edoras_tools.addons.operations.metrics import ServedWatcher, metrics_text
from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.workbench import Settings, open_files

parser = pytest.importorskip("prometheus_client.parser")
ROVER = CAPTURES / "a_rover.pcap"


@pytest.fixture(scope="module")
def report():
    source = open_files([ROVER])
    return inspect(source, Settings([MISSIONS / "rover_ground.yaml"]).workbench(source.info))


def read(text):
    """Return the samples by name, each with labels and value; the parser refuses what is no such text."""
    found = {}
    for family in parser.text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def test_all_figures_of_a_run_are_there(report):
    summary = report.summary()
    found = read(metrics_text(summary))
    assert found["edoras_datagrams_total"] == [({}, summary["datagrams"])]
    assert found["edoras_start_seconds"][0][1] == pytest.approx(summary["start_ns"] / 1e9)
    assert "edoras_capture_drops_total" not in found, "a pcap does not tell"
    for name, key in (("count_total", "count"), ("rate_hz", "rate_hz"), ("gaps", "gaps")):
        rows = {row["topic"]: row[key] for row in summary["routes"] if row["topic"]}
        told = {labels.get("topic"): value for labels, value in found[f"edoras_routes_{name}"]}
        assert told == told | rows
    findings = {labels["finding"]: value for labels, value in found["edoras_findings_total"]}
    assert findings == summary["findings"]
    assert found["edoras_info"][0][0]["source"] == str(ROVER)


def test_texts_are_escaped_and_rows_that_are_alike_are_added():
    rows = [
        {"name": 'a"b\\c\nd', "count": 1},
        {"name": 'a"b\\c\nd', "count": 2},
        {"name": "e", "count": None},
    ]
    found = read(metrics_text({"routes": rows, "connected": True, "notes": ["x"]}))
    assert found["edoras_routes_count_total"] == [({"name": 'a"b\\c\nd'}, 3.0)]
    assert found["edoras_connected"] == [({}, 1.0)]


def test_who_asks_gets_the_figures_of_now_and_the_run_does_not_wait(report, capsys):
    over, seen = threading.Event(), []
    inner = nullcontext(type("Watcher", (), {"update": lambda _, run: seen.append(run)})())
    with ServedWatcher(inner, Endpoint("127.0.0.1", 0)) as served:
        url = capsys.readouterr().err.split()[-1]
        served.update(report)  # nobody has asked: nothing is made

        def run():
            while not over.wait(0.01):
                served.update(report)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            with urllib.request.urlopen(url) as answer:
                assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
                found = read(answer.read().decode())
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"{url}/no")
        finally:
            over.set()
            thread.join()
        assert found["edoras_datagrams_total"] == [({}, report.summary()["datagrams"])]
        assert seen
        port = int(url.split(":")[2].split("/")[0])
        with pytest.raises(CaptureError, match="cannot be listened on: Address already in use"):
            ServedWatcher(nullcontext(), Endpoint("127.0.0.1", port)).__enter__()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url)
