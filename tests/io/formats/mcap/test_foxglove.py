"""Recordings of the samples, read by Foxglove's own libraries and by rosbags: the same values."""

import json
import math
import subprocess
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from effort import long_but
from places import ROOT, SAMPLE_MISSIONS, SMALL_SAMPLES, SUPPORT
from rosbags.highlevel import AnyReader

from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings, open_files

NPM = ROOT / ".npm"
ABSENT = NPM / "absent"
WHY = ABSENT.read_text().strip() if ABSENT.exists() else "Foxglove's libraries are not installed: make npm"


def plain(value):
    """A value of rosbags as Foxglove's reader has it: 64 bits and what is no number as text."""
    if is_dataclass(value):
        return {
            item.name: plain(getattr(value, item.name)) for item in fields(value) if item.name[0].islower()
        }
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "iu":
            return [str(item) for item in value.tolist()] if value.dtype.itemsize == 8 else value.tolist()
        return [plain(item) for item in value.tolist()]
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def same(theirs, ours):
    """Whether both have the same values; integers of 64 bits are texts there."""
    if theirs == ours:
        return True
    if isinstance(ours, dict):
        return theirs.keys() == ours.keys() and all(same(theirs[name], ours[name]) for name in ours)
    if isinstance(ours, list):
        return len(theirs) == len(ours) and all(map(same, theirs, ours))
    return theirs == (str(ours) if isinstance(theirs, str) else ours)


@pytest.mark.quick("b_arm_single")
@pytest.mark.skipif(not (NPM / "node_modules/@mcap/core").exists(), reason=WHY)
@pytest.mark.parametrize("sample", long_but(SMALL_SAMPLES, SAMPLE_MISSIONS))
def test_every_message_is_the_same_to_foxglove_and_to_rosbags(sample, tmp_path):
    path = tmp_path / "a.mcap"
    (capture,) = (ROOT / "samples/captures").glob(f"{sample}.pcap*")
    bench = Settings([ROOT / f"samples/missions/{name}.yaml" for name in SAMPLE_MISSIONS[sample]]).workbench()
    record(open_files([capture]), bench, Target(path))
    done = subprocess.run(
        ["node", SUPPORT / "foxglove_reader.mjs", NPM, path], capture_output=True, text=True, check=True
    )
    told = {}
    for topic, time_ns, values in map(json.loads, done.stdout.splitlines()):
        told.setdefault(topic, []).append((int(time_ns), values))
    ours = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            values = plain(reader.deserialize(data, connection.msgtype))
            ours.setdefault(connection.topic, []).append((time_ns, values))
    assert told.keys() == ours.keys()
    assert {"/edoras/datagrams", "/edoras/link_statistics"} < told.keys()
    for topic, messages in ours.items():
        assert [at for at, _ in told[topic]] == [at for at, _ in messages], topic
        wrong = [pair for pair in zip(told[topic], messages, strict=True) if not same(pair[0][1], pair[1][1])]
        assert not wrong, (topic, wrong[:1])
