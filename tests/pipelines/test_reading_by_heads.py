"""Topics, MsgIds and links of a recording come by its index as they come by reading all of it."""

import os
from pathlib import Path

import pytest
from effort import LONG, long_but
from places import CAPTURES, MISSIONS, SAMPLES

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.formats.mcap import chunks, reader
from edoras_tools.io.formats.recover import repair
from edoras_tools.pipelines import reading as loops
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.export import sources
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import Limits, selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files

SETTINGS = Settings(tuple(sorted(MISSIONS.glob("*rovers*.yaml"))))
GIVEN = Path(os.environ.get("EDORAS_CAPTURES", "/nowhere"))
FILES = {
    path.name.split(".")[0]: path
    for path in [*SAMPLES.glob("rtps/*.pcap.gz"), *CAPTURES.glob("*.pcap*"), *GIVEN.glob("*.pcap")]
}
FEW = ["f_sbn_disconnect"]
BY_HEADS = {"a_rover", "f_sbn_disconnect", "b_arm_single", "e_ci_errors"}


@pytest.fixture(scope="module", autouse=True)
def small():
    """Small chunks and batches: of each capture there are several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "CHUNK_BYTES", 16 << 10)
        patch.setattr(reader, "_BATCH_BYTES", 32 << 10)
        yield


def shown(paths, selection, count=0):
    """What a list of the selected rows says, and how many datagrams were passed over."""
    source, bench = open_inputs(paths, Settings())
    rows = []
    try:
        for some in selected_rows(source, bench, selection, Limits(count)):
            batch, columns = some.alone()
            findings = (columns.findings | batch.capture_findings).tolist()
            rows += zip(batch.number.tolist(), batch.time_ns.tolist(), findings, columns.route, strict=True)
    except CaptureError as error:
        rows.append(str(error))
    context = bench.columns.context
    return (rows, context.notes, context.unnamed), source.statistics.passed_over


def table(paths, topic, folder):
    """The table of a topic, and what is said of it."""
    source = sources.open_topics(paths, Settings())
    target = ExportTarget.of(folder / "table.csv", force=True)
    try:
        said = export(source, target, [topic]).summary()
    except EdorasError as error:
        return str(error)
    return said, target.path.read_bytes(), source.zero_ns, source.last_ns, source.unnamed


def compared(paths, monkeypatch, folder):
    """Return how many datagrams were passed over; all that is shown must be the same by reading all."""
    source, bench = open_inputs(paths, Settings())
    source.close()
    topics = [*sorted(route.topic for route in bench.mission.routes), "/cfs/CFE_ES_HousekeepingTlm"]
    topics = topics if LONG else topics[-1:]
    selections = [
        *(Selection(topics=(topic,)) for topic in topics),
        *(Selection(msg_ids=(msg_id,)) for msg_id in ((0x800, 0x1806) if LONG else ())),
        *(Selection(links=(link,)) for link in bench.columns.context.links if LONG and link.packets),
        Selection(msg_ids=(0x82A,), where="linear.x > 0"),
    ]
    passed, results = 0, []
    for whole in (False, True):
        with monkeypatch.context() as patch:
            if whole:
                for module in (loops, sources):
                    patch.setattr(module, "reads_by_heads", lambda *_: False)
            result = []
            for selection in selections:
                rows, over = shown(paths, selection)
                result.append((str(selection), rows, shown(paths, selection, 3)[0]))
                passed += over
                assert not (whole and over)
            result += [(topic, table(paths, topic, folder)) for topic in topics[::2]]
            results.append(result)
    for by_heads, all_read in zip(*results, strict=True):
        assert by_heads == all_read
    return passed


@pytest.mark.parametrize("name", long_but(FEW, sorted(FILES)))
def test_what_is_asked_for_comes_as_if_all_was_read(name, monkeypatch, tmp_path):
    path = tmp_path / "a.mcap"
    record(open_files([FILES[name]]), SETTINGS.workbench(), Target(path))
    passed = compared([path], monkeypatch, tmp_path)
    assert passed or name not in BY_HEADS


@pytest.mark.long
def test_cut_split_and_repaired_recordings_and_several(monkeypatch, tmp_path):
    whole, cut, parts = tmp_path / "a.mcap", tmp_path / "cut.mcap", tmp_path / "parts.mcap"
    record(open_files([FILES["f_sbn_disconnect"]]), SETTINGS.workbench(), Target(whole))
    record(open_files([FILES["a_rover"]]), SETTINGS.workbench(), Target(parts, split_count=700))
    cut.write_bytes(whole.read_bytes()[:-30_000])
    damaged, repaired = tmp_path / "damaged.mcap", tmp_path / "repaired.mcap"
    octets = whole.read_bytes()
    damaged.write_bytes(octets[:60_000] + bytes(9_000) + octets[69_000:])
    assert repair(damaged, repaired).lost
    many = sorted(tmp_path.glob("parts_*.mcap"))
    for paths in ([cut], many, [whole, many[0]], [repaired])[:: 1 if LONG else 3]:
        assert not compared(paths, monkeypatch, tmp_path)
