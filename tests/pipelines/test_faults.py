"""Scenarios: what a file says becomes rules; what is wrong in it is told with file, line and key."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import SAMPLES

from edoras_tools.errors import ConfigError
from edoras_tools.links.bare import CI
from edoras_tools.pipelines.faults import fault_plan, load_scenario
from edoras_tools.sessions.faults.rules import parse_rule

SAMPLES = SAMPLES / "scenarios"


@pytest.fixture
def written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def write(text):
        path = Path("s.yaml")
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_a_file_says_the_same_as_the_command_line(written):
    path = written(
        """\
seed: 0x2a
profile: geo
faults:
  - drop: 0.1
    msg_id: [0x1827, 0x1828]
    from: 10s
  - checksum:
    link: ci
  - delay:200ms,to=cfs
"""
    )
    plan = load_scenario(path)
    assert plan.seed == 42
    texts = [rule.text for rule in plan.rules]
    assert texts[4:] == ["drop:0.1,msg_id=0x1827|0x1828,from=10s", "checksum,link=ci", "delay:200ms,to=cfs"]
    assert [parse_rule(text) for text in texts] == list(plan.rules)
    assert plan.rules[5].scope.links == {CI}


@pytest.mark.parametrize("path", sorted(SAMPLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_samples_are_read(path):
    assert load_scenario(path).rules


MISTAKES = {
    "seed: -1\nfaults: [drop:1]\n": ["s.yaml:1: seed: a whole number is needed"],
    "profil: geo\nfaults: []\n": ["s.yaml:1: profil: no such key; did you mean profile?"],
    "profile: luna\n": ["s.yaml:1: profile: no such profile 'luna'; did you mean lunar?"],
    "faults:\n  - drip: 0.1\n": ["s.yaml:2: faults[0]: none of drip is a fault; did you mean drop?"],
    "faults:\n  - drop: 1\n    delay: 1s\n": [
        "s.yaml:2: faults[0]: drop and delay in one fault; make them two"
    ],
    "faults:\n  - delay: soon\n    mid: 3\n": [
        "s.yaml:2: faults[0].delay: time 'soon': a length of time is needed",
        "s.yaml:3: faults[0].mid: delay takes no 'mid'",
    ],
    "faults:\n  - drop: 1\n    until: 1s\n    from: 2s\n": ["s.yaml:3: faults[0].until: until is not later"],
    "faults:\n  - drop: 1\n    drop: 1\n": ["s.yaml:2: faults[0]: drop and drop in one fault"],
    "faults:\n  - drop: 1\n    p: 1\n    p: 1\n": ["s.yaml:", "s.yaml:"],
    "faults:\n  - drop:7\n  - pad: {a: 1}\n": [
        "s.yaml:2: faults[0]: fault drop:7: p '7': a probability",
        "s.yaml:3: faults[1].pad: a plain value",
    ],
    "faults:\n  - truncate:\n": ["s.yaml:2: faults[0].truncate: truncate needs bytes"],
    "faults:\n  - []\n  -\n": [
        "s.yaml:2: faults[0]: a fault is needed",
        "s.yaml:3: faults[1]: a fault is needed",
    ],
    "faults: drop\n": ["s.yaml:1: faults: a list is needed"],
    "faults: &a [drop:1]\nfaults: *a\n": [
        "s.yaml:2: faults: given twice",
        "s.yaml:2: faults: a list is needed",
    ],
    "seed: 1\n": ["s.yaml:1: it contains no fault; a scenario needs faults:"],
    "- drop: 1\n": ["s.yaml:1: a scenario needs faults:"],
    "": ["s.yaml:1: the file is empty; a scenario needs faults:"],
    "faults: [drop:1]\n---\nfaults: []\n": ["s.yaml:3: a second document"],
    "faults: [1, 2\nb: }": ["s.yaml:2: not YAML: "],
    b"\xff\xfe\xff": ["s.yaml:1: not UTF-8 at byte 0"],
    b"# " + bytes(600_000): ["s.yaml: larger than 512 KiB"],
}


@pytest.mark.parametrize("text", MISTAKES, ids=range(len(MISTAKES)))
def test_all_mistakes_are_told_with_file_line_and_key(written, text):
    with pytest.raises(ConfigError) as caught:
        load_scenario(written(text))
    told, wanted = list(caught.value.mistakes), MISTAKES[text]
    assert len(told) == len(wanted), told
    assert all(line.startswith(start) for line, start in zip(told, wanted, strict=True)), told


def test_a_file_that_is_not_there_is_told():
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read \(No such file"):
        load_scenario(Path("nowhere.yaml"))


def test_profile_options_and_scenario_go_together_and_the_nearest_seed_holds(written):
    path = written("seed: 5\nfaults: [drop:0.5]\n")
    assert [rule.text for rule in fault_plan(["pad:3"], "mars", path).rules] == [
        "delay:182s",
        "bandwidth:32k",
        "drop:0.001",
        "pad:3",
        "drop:0.5",
    ]
    assert fault_plan(scenario=path).seed == 5
    assert fault_plan(scenario=path, seed=0).seed == 0
    assert not fault_plan()


def test_mistakes_of_options_and_scenario_are_told_together(written):
    with pytest.raises(ConfigError) as caught:
        fault_plan(["drop:2", "pad:x"], "moon", written("faults: [drip:1]\n"))
    assert len(caught.value.mistakes) == 4


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.binary(max_size=80) | st.text("faults:- drop\n0.1,=[]{}&*'\"#", max_size=60).map(str.encode))
def test_any_bytes_are_a_scenario_or_mistakes(written, text):
    told = []
    try:
        load_scenario(written(text))
    except ConfigError as error:
        told += error.mistakes
    assert all(line.startswith("s.yaml") for line in told)
