"""Files of expectations: what they say, and every mistake with its line."""

import inspect

import pytest

from edoras_tools.addons.runs import expectations
from edoras_tools.addons.runs.expectations import EventExpectation, load_expectations
from edoras_tools.errors import ConfigError


def load(folder, text):
    path = folder / "expect.yaml"
    path.write_text(text)
    return load_expectations(path)


def test_the_example_of_the_module(tmp_path):
    example = inspect.getdoc(expectations).partition("::\n")[2].partition("\nAll errors")[0]
    made = load(tmp_path, inspect.cleandoc(example))
    (topic,) = made.topics
    assert topic.bounds.keys() == expectations.TOPIC_BOUNDS.keys()
    assert [item.sort for item in topic.fields] == ["always", "never", "at least once", "after"]
    assert (topic.fields[3].then, topic.fields[3].within_ns) == ("pose.position.x > 1", 2_000_000_000)
    assert [item.must for item in made.events] == [True, False]
    assert (made.findings, made.verdicts) == ({"stale_tail"}, {"app_pipe_limit"})
    assert made.bounds.keys() == {"lost", "duration"}


def test_what_is_not_said_is_not_expected(tmp_path):
    made = load(tmp_path, "findings: []\n")
    assert (made.findings, made.verdicts, made.topics, made.bounds) == (frozenset(), None, (), {})


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("Pipe Overflow", 'cfe_event.message contains "Pipe Overflow"'),
        (
            "CFE_SB 7: Err",
            'cfe_event.app_name == "CFE_SB" and cfe_event.event_id == 7 and cfe_event.message contains "Err"',
        ),
        ("TO_LAB_APP 3", 'cfe_event.app_name == "TO_LAB_APP" and cfe_event.event_id == 3'),
        ('say "x\\y"', 'cfe_event.message contains "say \\"x\\\\y\\""'),
    ],
)
def test_events_as_the_doctor_quotes_them(text, where):
    assert EventExpectation(must=True, text=text, line=1).where == where


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", ["1: the file is empty"]),
        ("{}", ["1: nothing is expected"]),
        ("- a\n", ["1: expectations are topics:"]),
        ("a: [1\n", ["not YAML"]),
        ("schema: 2\n", ["1: schema: this version reads schema 1"]),
        ("topic:\n  /a: {count: 1}\n", ["1: topic: no such key; did you mean topics?"]),
        ("topics: {/a: {rat: 9..11}}\n", ["1: topics./a.rat"]),
        ("topics: {/a: 5}\n", ["1: /a: keys are needed: count, rate"]),
        ("topics: {/a: {count: }}\n", ["1: /a.count: a value is needed"]),
        ("topics: {/a: {count: 1, count: 2}}\n", ["1: /a.count: given twice"]),
        ("topics: {/a: {rate: 10}}\n", ["1: /a.rate: '10' is no bound; write 9..11"]),
        ("topics: {/a: {fields: x}}\n", ["1: /a.fields: a list is needed"]),
        (
            "topics:\n  /a:\n    fields:\n    - {is: x}\n",
            ["4: /a.fields[0].is: no such key", "one of always, never"],
        ),
        ("topics: {/a: {fields: [{always: x, never: y}]}}\n", ["1: /a.fields[0]: one of always"]),
        ("topics: {/a: {fields: [{always: x, within: 2s}]}}\n", ["within can only be used with after:"]),
        ("topics: {/a: {fields: [{after: x}]}}\n", ["after: needs within: and then:"]),
        ("topics: {/a: {fields: [{after: x, within: soon, then: y}]}}\n", ["a length of time is needed"]),
        ("topics: {/a: {fields: [{always: x >}]}}\n", ["1: /a.fields[0].always: character 4:"]),
        ("events: {must: {a: b}}\n", ["1: events.must: a value is needed"]),
        ("events: {may: x}\n", ["1: events.may: no such key"]),
        ("findings: [stale_tial]\n", ["'stale_tial' is no finding; did you mean stale_tail?"]),
        ("verdicts: [app_pipe_limits]\n", ["did you mean app_pipe_limit?"]),
        ("lost: 1\n---\nlost: 2\n", ["a second document"]),
        ("lost: x\nduration: y\n", ["1: lost: 'x' is no bound", "2: duration: 'y' is no bound"]),
    ],
)
def test_mistakes(text, told, tmp_path):
    with pytest.raises(ConfigError) as found:
        load(tmp_path, text)
    assert len(found.value.mistakes) == len(told)
    for line, part in zip(found.value.mistakes, told, strict=True):
        assert line.startswith(f"{tmp_path}/expect.yaml:")
        assert part.partition("topics.")[2] in line if "topics./" in part else part in line


@pytest.mark.parametrize("content", [b"\xff\xfe", bytes(300_000), b"\x00"])
def test_no_text(content, tmp_path):
    path = tmp_path / "expect.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"expect\.yaml"):
        load_expectations(path)


def test_no_file(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot be read .*; name a file of expectations"):
        load_expectations(tmp_path / "none.yaml")
