"""Sentences that a stranger read wrongly do not come back: in messages, help texts and pages."""

import re

import pytest
from places import ROOT

BANNED = (
    "states that a robot sends, or traffic of another link",
    "are older than its first 0x803",
    "more missing by an estimate",
    "not observable from here",
    "in no figure of the balance",
    "told to be lost elsewhere",
    "no more than is told elsewhere",
    "what is there and not here",
    "what listens there reads",
    "nothing is wrong with this link for",
    "events CFE_SB 17 came",
    "is the highest clean rate",
    "spans of time,",
    "not told by this format",
    "with a type that alone fits",
    "different messages, as do",
    "lost or unaccounted for of any route",
    "Show notes in lists",
    "name both, the recording and the expectations",
    "the luckiest packet",
    "what no command of the capture became",
    "what of it did not go in there",
    "what is of no known route too",
    "stays there, and the older one too",
    "one that is left alone takes both",
    "and counted as the inner one",
    "told from its next version",
    "the executive, and it with its applications",
)
"""Each was met in a message or page; what is said now stands in its place."""
FILES = [
    *sorted((ROOT / "edoras_tools").rglob("*.py")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
    ROOT / "samples/README.md",
]


def words(path):
    """Return all text of a page or of a program, whose strings may be in parts, with single spaces."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        text = re.sub(r"""["']\s+[rbf]*["']""", "", text)
    return re.sub(r"\s+", " ", text)


@pytest.fixture(scope="module")
def texts():
    return {path.relative_to(ROOT): words(path) for path in FILES}


@pytest.mark.parametrize("phrase", BANNED)
def test_a_sentence_that_was_misread_is_gone(phrase, texts):
    assert [str(path) for path, text in texts.items() if phrase in text] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


def test_what_is_looked_through_is_what_people_read(texts):
    """A sentence that is broken over lines is found, in a program and in a page."""
    (summary,) = (
        text for path, text in texts.items() if path.name == "summary.py" and path.parent.name == "diagnosis"
    )
    assert "gave way to newer ones, as the application does." in summary
    assert "Line 1 is the total, in messages. Then come the three worst problems" in next(
        text for path, text in texts.items() if path.name == "doctor.md"
    )
