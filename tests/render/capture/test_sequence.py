"""Sequence diagrams as text."""

from edoras_tools.render.capture.sequence import SequenceMessage, mermaid, plantuml

MESSAGES = [
    SequenceMessage("SBN 66:1", "SBN 66:3", "SUB", 36, 0, 70_000_000_000),
    SequenceMessage("SBN 66:3", "SBN 66:1", "PROTO", 1, 512_000_000, 512_000_000, ["sbn_version_mismatch"]),
    SequenceMessage(
        "Ground 10.0.0.1",
        "CI 10.0.0.2:1234",
        "0x1827 /cmd_vel",
        600,
        10**9,
        60_900_000_000,
        ["sequence_unset"],
    ),
    SequenceMessage("SBN 66:3", "SBN 66:1", "UNSUB", 2, 2_000_000_000, 2_000_010_000),
]


def test_mermaid():
    assert list(mermaid(MESSAGES)) == [
        "sequenceDiagram",
        "    participant P1 as SBN 66:1",
        "    participant P2 as SBN 66:3",
        "    participant P3 as Ground 10.0.0.1",
        "    participant P4 as CI 10.0.0.2:1234",
        "    P1->>P2: SUB x36 every 2.0 s, 0.000 to 70.000 s",
        "    P2->>P1: PROTO, 0.512 s ! sbn_version_mismatch",
        "    P3->>P4: 0x1827 /cmd_vel x600 every 100 ms, 1.000 to 60.900 s",
        "    P2->>P1: UNSUB x2, 2.000 to 2.000 s",
    ]


def test_plantuml():
    assert list(plantuml(MESSAGES)) == [
        "@startuml",
        'participant "SBN 66:1" as P1',
        'participant "SBN 66:3" as P2',
        'participant "Ground 10.0.0.1" as P3',
        'participant "CI 10.0.0.2:1234" as P4',
        "P1 -> P2: SUB x36 every 2.0 s, 0.000 to 70.000 s",
        "P2 -> P1: PROTO, 0.512 s ! sbn_version_mismatch",
        "P3 -> P4: 0x1827 /cmd_vel x600 every 100 ms, 1.000 to 60.900 s",
        "P2 -> P1: UNSUB x2, 2.000 to 2.000 s",
        "@enduml",
    ]


def test_labels_cannot_write_diagrams():
    hostile = [SequenceMessage("a", "b", "/x;\nP1->>P2: #y <b> //z// \x1b[0m", 1, 0, 0)]
    *_, drawn = mermaid(hostile)
    assert drawn == r"    P1->>P2: /x#59;\nP1-#62;#62;P2: #35;y #60;b#62; //z// \x1b[0m, 0.000 s"
    *_, drawn, _ = plantuml(hostile)
    assert drawn == r"P1 -> P2: /x;\nP1->>P2: #y ~<b> ~//z~// \x1b[0m, 0.000 s"


def test_nothing_said():
    assert list(mermaid([])) == ["sequenceDiagram"]
    assert list(plantuml([])) == ["@startuml", "@enduml"]
