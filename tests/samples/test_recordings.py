"""The sample of another tool's recording is what the script writes, as rosbags reads it."""

from others import messages, read_bag, write_bag
from places import SAMPLES

from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.workbench import Settings


def test_the_sample_is_what_rosbags_writes(tmp_path):
    source, bench = open_inputs([SAMPLES / "recordings/robot.mcap"], Settings())
    found = [
        (item.time_ns, bench.mission.routes[item.topic].topic, item.payload)
        for batch in source.batches()
        for item in batch
    ]
    source.close()
    said = read_bag(write_bag(tmp_path / "bag", count=60))
    assert found == [(time_ns, topic, data) for time_ns, topic, _, data in said]
    assert len(found) == len(list(messages(60))) == 124
