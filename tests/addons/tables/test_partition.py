"""Hive folders, as other programs read them."""

import json
import shutil

import pytest
from places import CAPTURES, MISSIONS

from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.workbench import Settings, open_files

PACKETS = 300


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("one") / "run.mcap"
    source = open_files([CAPTURES / "a_rover.pcap"])
    bench = Settings([MISSIONS / "rover_ground.yaml"]).workbench(source.info)
    record(source, bench, Target(path), limits=Limits(count=PACKETS))
    return path


def runs(folder, recording, count):
    folder.mkdir()
    for place in range(count):
        shutil.copy(recording, folder / f"run_{place:03}.mcap")
    return folder


@pytest.mark.quick("3")
@pytest.mark.parametrize("count", [3, 500])
def test_four_programs_read_the_same(call, tmp_path, recording, count):
    duckdb, polars, pandas, dataset = map(
        pytest.importorskip, ("duckdb", "polars", "pandas", "pyarrow.dataset")
    )
    done = call("export", runs(tmp_path / "runs", recording, count), "--partition", "-o", f"{tmp_path}/t/")
    assert done.code == 0
    assert len(done.err) == len([*(tmp_path / "t").iterdir()])
    assert f"{tmp_path}/t/cmd_vel/: " in "\n".join(done.err)
    folder = tmp_path / "t/cmd_vel"
    assert len([*folder.glob("recording=run_*/data.parquet")]) == count
    one = len(pandas.read_parquet(folder / "recording=run_000/data.parquet"))
    expected = {f"run_{place:03}": one for place in range(count)}
    assert one > 5
    query = f"SELECT recording, count(*) FROM read_parquet('{folder}/*/*.parquet', hive_partitioning=true)"
    assert dict(duckdb.sql(f"{query} GROUP BY recording").fetchall()) == expected
    frame = polars.scan_parquet(folder, hive_partitioning=True).group_by("recording").len().collect()
    assert dict(frame.iter_rows()) == expected
    assert pandas.read_parquet(folder).groupby("recording", observed=True).size().to_dict() == expected
    table = dataset.dataset(folder, partitioning="hive").to_table(columns=["recording"])
    assert {row["values"]: row["counts"] for row in table["recording"].value_counts().to_pylist()} == expected


def test_one_that_is_cut_off_and_one_without_the_topic_hold_up_no_other(call, tmp_path, recording):
    folder = runs(tmp_path / "runs", recording, 3)
    (folder / "run_001.mcap").write_bytes(recording.read_bytes()[:200])
    shutil.copy(CAPTURES / "a_rover.pcap", folder / "run_002.pcap")
    (folder / "run_002.mcap").unlink()
    words = ("export", folder, "--partition", "--topic", "cmd_vel", "-o", f"{tmp_path}/t/")
    done = call(*words)
    assert done.code == 1
    assert "1 of 3 recordings could not be read whole" in done.err[-1]
    assert [path.parent.name for path in (tmp_path / "t/cmd_vel").glob("*/*")] == ["recording=run_000"]
    done = call(*words, "--force", "--json")
    (item,) = json.loads(done.out)["files"]
    assert (item["recording"], item["topic"]) == ("run_000", "/cmd_vel")


@pytest.mark.parametrize(
    ("output", "line"),
    [("a.parquet", "--partition writes folders"), ("t/", "no capture or recording is there")],
)
def test_bad_input_is_one_line(call, tmp_path, output, line):
    done = call("export", tmp_path, "--partition", "-o", f"{tmp_path}/{output}")
    assert done.code in {1, 2}
    assert line in done.err[-1]
