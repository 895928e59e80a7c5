"""A capture held to expectations: what passes, what fails, and the counts that are told."""

import numpy as np
import pytest
from places import CAPTURES, MISSIONS

from edoras_tools.addons.runs.check import check
from edoras_tools.addons.runs.expectations import load_expectations
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io import SourceDefaults
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.selection import Period
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

ROVER = CAPTURES / "a_rover.pcap"
SETTINGS = Settings([MISSIONS / "rover_ground.yaml"])


@pytest.fixture
def checked(tmp_path):
    """A function: the results for a capture, by what they are about and the expectation."""

    def run(text, path=ROVER, scope=None, source=None):
        file = tmp_path / "expect.yaml"
        file.write_text(text)
        source = source or open_files([path])
        report = check(source, SETTINGS.workbench(source.info), load_expectations(file), scope=scope)
        return {(item.about, item.expectation): item for item in report.results}

    return run


def one(checked, topic, text):
    """Return whether an expectation of a topic is met, and what was found."""
    (item,) = (
        item for item in checked(f"topics: {{{topic}: {text}}}\n").values() if item.about != "verdicts"
    )
    return item.passed, item.found


@pytest.mark.each(3)
@pytest.mark.long("cmd_vel-*", "0x1827-*", "*at most 16%*", "*at most 91*", "SBN_HK-{count*", "*70..75*")
@pytest.mark.parametrize(
    ("topic", "text", "passed", "found"),
    [
        ("/cmd_vel", "{count: 600}", True, "600 messages"),
        ("cmd_vel", "{count: at least 601}", False, "600 messages"),
        ("0x1827", "{count: 600}", True, "600 messages"),
        ("SB_HK", "{count: 63}", True, "63 messages"),
        ("/cmd_vel", "{rate: 9.9..10.1}", True, "10 Hz"),
        ("/cmd_vel", "{rate: at least 11}", False, "10 Hz"),
        ("/cmd_vel", "{size: 76}", True, "76 bytes"),
        ("/cmd_vel", "{size: 70..75}", False, "76 bytes"),
        ("TO_CMD", "{rate: at least 1}", False, "not seen: at least two messages are needed"),
        ("SBN_HK", "{size: at most 10}", False, "no message"),
        ("SBN_HK", "{count: 0}", True, "no message"),
        ("SBN_HK", "{lost: 0}", False, "no message"),
        ("/cmd_vel", "{lost: at most 15%}", False, "92 of 600 (15.33%)"),
        ("/cmd_vel", "{lost: at most 16%}", True, "92 of 600 (15.33%)"),
        ("/cmd_vel", "{lost: at most 92}", True, "92 of 600 (15.33%)"),
        ("/cmd_vel", "{lost: at most 91}", False, "92 of 600 (15.33%)"),
        ("/telemetry_pose", "{lost: 0}", True, "0 of 63 (0.00%)"),
        ("TO_CMD", "{latency: at most 1s}", False, "the capture does not show it"),
    ],
)
def test_bounds_of_topics(topic, text, passed, found, checked):
    assert one(checked, topic, text) == (passed, found)


def test_losses_are_those_of_the_balance(checked):
    found = checked("lost: at most 7%\nsuperseded: 0\nunaccounted: 0\nduration: 65s..66s\n")
    told = {key: (item.passed, item.found) for (about, key), item in found.items() if about == "capture"}
    assert told == {
        "lost": (False, "92 of 1,183 (7.78%)"),
        "superseded": (True, "0 of 1,183 (0.00%)"),
        "unaccounted": (True, "0 of 1,183 (0.00%)"),
        "duration": (True, "65.3 s"),
    }


def test_a_silence_includes_the_ends_of_the_capture(checked):
    text = "topics: {/cmd_vel: {silence: at most 1s}}\n"
    assert checked(text)["/cmd_vel", "silence"].found == "3.8 s"  # the first command comes so late
    middle = checked(text, scope=Scope(period=Period(10 * SECOND, 20 * SECOND)))
    assert middle["/cmd_vel", "silence"].passed


def test_latency_is_the_99th_percentile_to_the_robot(checked):
    passed, found = one(checked, "/cmd_vel", "{latency: at most 600ms}")
    assert passed
    assert 100 < float(found.removesuffix(" ms")) < 600


FIELDS = [
    ("always: linear.x in 0..1", True, "600 of 600 messages"),
    (
        "always: angular.z == 7",
        False,
        "0 of 600 messages pass; of those that do not, the first is packet 94 at 3.776 s",
    ),
    ("never: linear.x > 1", True, "0 of 600 messages"),
    ("never: time > 60", False, " of 600 messages; the first is packet "),
    ("at least once: linear.x == 0.5", True, " messages; the first is packet 94 at 3.776 s"),
    ("at least once: linear.x == 7", False, "0 of 600 messages"),
    ("{after: linear.x > 0, within: 2s, then: pose.position.x >= 0}", True, "600 of 600 were followed"),
    (
        "{after: linear.x > 0, within: 100ms, then: pose.position.x >= 0}",
        False,
        " of 600 were followed; the first that was not is at ",
    ),
    ("{after: linear.x > 1, within: 2s, then: pose.position.x >= 0}", False, "0 of 0 were followed"),
]


def test_fields(checked):
    rules = [field if field.startswith("{") else f"{{{field}}}" for field, _, _ in FIELDS]
    results = checked(f"topics: {{/cmd_vel: {{fields: [{', '.join(rules)}]}}}}\n")
    items = [item for item in results.values() if item.about != "verdicts"]
    for item, (field, passed, text) in zip(items, FIELDS, strict=True):
        assert (item.passed, text in item.found) == (passed, True), field


@pytest.mark.long
def test_every_batch_counts_alike(checked):
    """However a source is cut into batches, the same is found."""
    text = (
        "topics:\n  /cmd_vel:\n    count: 600\n    silence: at most 9s\n    fields:\n"
        "    - never: time > 60\n    - {after: time > 50, within: 150ms, then: linear.x > 0}\n"
    )

    class Small(SourceDefaults):
        def __init__(self):
            self.inner = open_files([ROVER])
            self.info, self.statistics = self.inner.info, self.inner.statistics

        def close(self):
            self.inner.close()

        def batches(self):
            for batch in self.inner.batches():
                for start in range(0, len(batch), 61):
                    yield batch.take(np.arange(start, min(start + 61, len(batch))))

    assert checked(text) == checked(text, source=Small())


def test_what_the_end_of_the_capture_leaves_open(checked):
    text = "topics: {/cmd_vel: {fields: [{after: time > 62, within: 9s, then: linear.x > 5}]}}\n"
    ((_, item),) = ((key, item) for key, item in checked(text).items() if key[0] == "/cmd_vel")
    assert not item.passed
    assert item.found.startswith("0 of ")
    assert item.found.endswith(" the capture ends too early")


def test_events(checked):
    found = checked(
        "events:\n  must: [TO telemetry output enabled, No such event]\n"
        "  never: ['CFE_SB 17: Msg Limit', 'CFE_SB 25']\n"
    )
    told = {item.expectation: (item.passed, item.found) for item in found.values()}
    assert told == {
        "TO telemetry output enabled": (True, "1 of 15 events; the first is packet 75 at 2.750 s"),
        "No such event": (False, "0 of 15 events"),
        "CFE_SB 17: Msg Limit": (False, "14 of 15 events; the first is packet 105 at 4.250 s"),
        "CFE_SB 25": (True, "0 of 15 events"),
    }


def test_each_verdict_that_is_not_allowed_fails_by_its_name(checked):
    found = checked("verdicts: []\n")
    assert found["verdicts", "app_pipe_limit"].found.startswith("92 of 600 commands")
    assert not found["verdicts", "app_pipe_limit"].passed
    assert checked("verdicts: [app_pipe_limit]\n")["verdicts", "allowed"].passed


def test_each_finding_that_is_not_allowed_fails_by_its_name(checked):
    path = CAPTURES / "e_ci_errors.pcap"
    strict = checked("findings: []\n", path)
    names = [name for about, name in strict if about == "findings"]
    assert strict["findings", "length_mismatch"].found == "8 datagrams"
    found = checked(f"findings: [{', '.join(names)}]\n", path)
    assert found["findings", "allowed"].passed


def test_what_is_wrong_with_the_capture_fails_unless_allowed(checked, tmp_path):
    """Frames that are cut make every other figure unsure."""
    data = bytearray(ROVER.read_bytes())
    at, cut = 24, bytearray(data[:24])
    while at < len(data):
        size = int.from_bytes(data[at + 8 : at + 12], "little")
        head, kept = data[at : at + 16], min(size, 70)
        head[8:12] = kept.to_bytes(4, "little")
        cut += head + data[at + 16 : at + 16 + kept]
        at += 16 + size
    path = tmp_path / "cut.pcap"
    path.write_bytes(cut)
    assert not checked("duration: at least 1s\n", path)["verdicts", "cut_frames"].passed
    assert ("verdicts", "cut_frames") not in checked("verdicts: [cut_frames]\n", path)


def test_a_source_that_ends_early_fails(checked, tmp_path):
    path = tmp_path / "half.pcap"
    path.write_bytes(ROVER.read_bytes()[:100_000])
    found = checked("duration: at least 1s\n", path)
    assert not found["capture", "input"].passed


def test_nothing_examined_fails(checked):
    class Nothing(SourceDefaults):
        def __init__(self):
            inner = open_files([ROVER])
            inner.close()
            self.info, self.statistics = inner.info, inner.statistics

        def close(self):
            pass

        def batches(self):
            yield from ()

    found = checked("lost: 0\n", source=Nothing())
    assert found["capture", "input"].found == "none"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("topics: {/cmd_vle: {count: 1}}", "no configured topic matches '/cmd_vle'; did you mean /cmd_vel?"),
        ("topics: {cmd_vle: {count: 1}}", "did you mean /cmd_vel?"),
        ("topics: {SB_HKK: {count: 1}}", "did you mean SB_HK?"),
        ("topics: {0x12345: {count: 1}}", "there are: /cmd_vel, /telemetry_pose"),
        ("topics: {/cmd_vel: {fields: [{always: linear.w > 1}]}}", "'linear.w' is not a field"),
        (
            "topics: {/cmd_vel: {fields: [{after: linear.x > 1, within: 1s, then: linear.w > 1}]}}",
            "'linear.w' is not a field",
        ),
    ],
)
def test_names_that_are_not_there(text, told, checked):
    with pytest.raises(ConfigError) as found:
        checked(text)
    (line,) = found.value.mistakes
    assert "expect.yaml:1: " in line
    assert told in line


def test_all_wrong_names_are_told_at_once(checked):
    with pytest.raises(ConfigError) as found:
        checked("topics:\n  /a: {count: 1}\n  /b: {count: 1}\n")
    assert len(found.value.mistakes) == 2


def test_what_is_not_there_is_no_capture(checked, tmp_path):
    with pytest.raises(CaptureError, match="no such file"):
        checked("lost: 0\n", tmp_path / "none.pcap")
