"""Scenarios: what goes wrong and when, from a YAML file and from the command line, as one plan.

::

    seed: 7
    profile: lunar              # a named link; see edoras proxy --help
    faults:
      - drop: 0.1               # a fault, and what its kind is told
        msg_id: 0x1827          # what it strikes, and when
        from: 10s
        until: 20s
      - silence: 12s
        from: 30s
      - delay:200ms,to=cfs      # or as --fault takes it

Every mistake of a file is told at once, with file, line and key.
"""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.mission.fields import suggestion
from edoras_tools.mission.report import Report, printable
from edoras_tools.mission.tree import Mapping, Scalar, Sequence, Tree, parse
from edoras_tools.sessions.fault_kinds import KINDS
from edoras_tools.sessions.fault_rules import make_rule, parse_profile, parse_rule
from edoras_tools.sessions.faults import FaultPlan

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from edoras_tools.sessions.fault_rules import Rule

FORM: Final = "a scenario is faults: with a list, as - drop: 0.1"
_KEYS: Final = ("seed", "profile", "faults")
_LARGEST: Final = 1 << 18
_LARGEST_SEED: Final = (1 << 64) - 1


def fault_plan(
    faults: Iterable[str] = (),
    profile: str | None = None,
    scenario: Path | None = None,
    seed: int | None = None,
) -> FaultPlan:
    """Put a plan together.

    Args:
        faults: rules, as ``drop:0.1``.
        profile: a named link; its rules come first.
        scenario: a YAML file; its rules come last.
        seed: instead of the scenario's; 0 where neither says.

    Raises:
        ConfigError: all mistakes at once.
    """
    rules: list[Rule] = []
    mistakes: list[str] = []
    plan = FaultPlan()
    for read, texts in ((parse_profile, [profile] if profile else []), (_one, faults)):
        for text in texts:
            try:
                rules += read(text)
            except ConfigError as error:
                mistakes += error.mistakes
    if scenario is not None:
        try:
            plan = load_scenario(scenario)
        except ConfigError as error:
            mistakes += error.mistakes
    if mistakes:
        raise ConfigError(*mistakes)
    return FaultPlan((*rules, *plan.rules), plan.seed if seed is None else seed)


def load_scenario(path: Path) -> FaultPlan:
    """Read a scenario.

    Raises:
        ConfigError: all mistakes at once, each with file, line and key.
    """
    report = Report(str(path))
    plan = FaultPlan()
    text = _read(path, report)
    documents = parse(text, report, FORM) if text is not None else []
    if text is not None and not documents and not report.mistakes:
        report.mistake(1, "", f"the file is empty; {FORM}")
    for document in documents[1:]:
        report.mistake(document.line, "", "a second document; a scenario is one")
    if documents:
        plan = _plan(documents[0], report)
    if report.mistakes:
        raise ConfigError(*(line for _, line in sorted(report.mistakes, key=itemgetter(0))))
    return plan


def _one(text: str) -> tuple[Rule, ...]:
    return (parse_rule(text),)


def _read(path: Path, report: Report) -> str | None:
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
    except OSError as error:
        report.mistake(0, "", f"cannot be read ({error.strerror or error}); give a scenario that can")
        return None
    if len(content) > _LARGEST:
        report.mistake(0, "", f"larger than {_LARGEST >> 10} KiB; {FORM}")
        return None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        report.mistake(line, "", f"not UTF-8 at byte {error.start}; {FORM}")
        return None


def _plan(tree: Tree, report: Report) -> FaultPlan:
    if not isinstance(tree, Mapping):
        report.mistake(tree.line, "", FORM)
        return FaultPlan()
    rules: list[Rule] = []
    seed = 0
    seen: set[str] = set()
    for key_tree, value in tree.entries:
        key = key_tree.text if isinstance(key_tree, Scalar) else ""
        if key in seen:
            report.mistake(key_tree.line, key, "given twice; once is enough")
        seen.add(key)
        if key == "seed":
            seed = _seed(value, report)
        elif key == "profile":
            rules += _profile(value, report)
        elif key == "faults":
            rules += _rules(value, report)
        else:
            what = f"no such key; {suggestion(key, _KEYS)}there are {', '.join(_KEYS)}"
            report.mistake(key_tree.line, key, what)
    if "faults" not in seen and "profile" not in seen and not report.mistakes:
        report.mistake(tree.line, "", f"nothing goes wrong in it; {FORM}")
    return FaultPlan(tuple(rules), seed)


def _seed(value: Tree, report: Report) -> int:
    number = value.value if isinstance(value, Scalar) else None
    if isinstance(number, int) and not isinstance(number, bool) and 0 <= number <= _LARGEST_SEED:
        return number
    report.mistake(value.line, "seed", f"a whole number is needed, from 0 to {_LARGEST_SEED}")
    return 0


def _profile(value: Tree, report: Report) -> tuple[Rule, ...]:
    try:
        return parse_profile(value.text if isinstance(value, Scalar) else "")
    except ConfigError as error:
        report.mistake(value.line, "profile", error.mistakes[0])
        return ()


def _rules(tree: Tree, report: Report) -> list[Rule]:
    if not isinstance(tree, Sequence):
        report.mistake(tree.line, "faults", "a list is needed, as - drop: 0.1")
        return []
    rules = []
    for index, item in enumerate(tree.items):
        key = f"faults[{index}]"
        rule = None
        if isinstance(item, Mapping):
            rule = _rule(item, key, report)
        elif isinstance(item, Scalar) and not item.missing:
            try:
                rule = parse_rule(item.text)
            except ConfigError as error:
                for what in error.mistakes:
                    report.mistake(item.line, key, what)
        else:
            report.mistake(item.line, key, "a fault is needed, as drop: 0.1")
        if rule is not None:
            rules.append(rule)
    return rules


def _rule(item: Mapping, key: str, report: Report) -> Rule | None:
    """Read a fault that is written as a mapping: the kind is the one key that names one."""
    words: list[tuple[str, str | None, int]] = []
    before = len(report.mistakes)
    for name_tree, value in item.entries:
        name = name_tree.text if isinstance(name_tree, Scalar) else ""
        text = _text(value)
        if text is None or not name:
            report.mistake(
                value.line, f"{key}.{printable(name)}", "a plain value or a list of them is needed"
            )
        else:
            words.append((name, text, name_tree.line))
    kinds = [word for word in words if word[0] in KINDS]
    if len(report.mistakes) > before:
        return None
    if len(kinds) != 1:
        names = [name for name, _, _ in words]
        what = (
            f"{' and '.join(name for name, _, _ in kinds)} in one fault; make them two"
            if kinds
            else f"none of {', '.join(names)} is a fault; {suggestion(names[0], KINDS)}"
            f"there are {', '.join(KINDS)}"
        )
        report.mistake(item.line, key, what)
        return None
    ((kind, told, _),) = kinds
    options = [(name, text) for name, text, _ in words if name != kind]
    own = [("", told)] if told else []
    written = ",".join([f"{kind}:{told}" if told else kind, *(f"{name}={text}" for name, text in options)])
    rule, mistakes = make_rule(kind, [*own, *options], written)
    lines = {name: line for name, _, line in words}
    for name, what in mistakes:
        report.mistake(lines.get(name or kind, item.line), f"{key}.{name or kind}", what)
    return rule


def _text(value: Tree) -> str | None:
    """Return a value as ``--fault`` writes it; None where it is none."""
    if isinstance(value, Scalar):
        return value.text
    if isinstance(value, Sequence):
        texts = [item.text for item in value.items if isinstance(item, Scalar)]
        return "|".join(texts) if texts and len(texts) == len(value.items) else None
    return None
