from __future__ import annotations

import pytest

from edoras_tools.model import Finding
from edoras_tools.render.severity import EXPLANATIONS, NOTABLE, Level, explain, ranked, worst


@pytest.mark.parametrize("finding", Finding, ids=lambda item: item.label)
def test_every_finding_is_explained_in_one_sentence(finding):
    told = explain(finding)
    assert told.meaning.endswith(".")
    assert "\n" not in told.meaning
    assert told.meaning.count(". ") == 0
    assert 0 < len(told.short) <= 16
    assert explain(finding.label) == told


def test_short_names_differ():
    assert len({told.short for told in EXPLANATIONS.values()}) == len(Finding)


def test_a_label_of_a_later_version_is_a_warning():
    assert explain("made_of_cheese").severity is Level.WARNING


def test_what_the_bridges_always_do_is_only_a_note():
    assert worst(Finding.CHECKSUM_ABSENT | Finding.SEQUENCE_UNSET) is Level.NOTE
    assert not NOTABLE & (Finding.CHECKSUM_ABSENT | Finding.SEQUENCE_UNSET)


def test_ranked_puts_the_gravest_first():
    some = Finding.SEQUENCE_UNSET | Finding.LENGTH_MISMATCH | Finding.CDR_INVALID
    assert ranked(some) == [Finding.CDR_INVALID, Finding.LENGTH_MISMATCH, Finding.SEQUENCE_UNSET]
    assert ranked(some, at_least=Level.ERROR) == [Finding.CDR_INVALID]
    assert worst(some) is Level.ERROR
    assert worst(Finding(0)) is None


def test_notable_is_what_is_more_than_a_note():
    for finding, told in EXPLANATIONS.items():
        assert (finding in NOTABLE) == (told.severity > Level.NOTE)
