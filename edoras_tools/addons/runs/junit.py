"""Results as JUnit XML, which continuous integration reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from edoras_tools.io.outputs import write_bytes
from edoras_tools.mission.report import printable

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from edoras_tools.addons.runs.check import CheckResult

_LONGEST: Final = 4000
"""Characters of a text; also, control characters are escaped, which XML cannot hold."""


def junit(results: Sequence[CheckResult], names: tuple[str, str, str], seconds: float = 0.0) -> bytes:
    """Return results as JUnit XML, a test case each.

    Args:
        names: of the command, of what runs were held to, and of the runs.
        seconds: how long these last.
    """
    command, suite_name, source_name = names
    failed = sum(not item.passed for item in results)
    counts = {"tests": str(len(results)), "failures": str(failed), "errors": "0"}
    root = Element("testsuites", {"name": f"edoras {command}", **counts})
    suite = SubElement(
        root,
        "testsuite",
        {"name": printable(suite_name, _LONGEST), **counts, "skipped": "0", "time": f"{seconds:.3f}"},
    )
    source = {"name": "source", "value": printable(source_name, _LONGEST)}
    SubElement(SubElement(suite, "properties"), "property", source)
    for item in results:
        name = printable(item.name, _LONGEST)
        case = SubElement(suite, "testcase", {"classname": printable(item.about), "name": name, "time": "0"})
        observed = printable(item.found, _LONGEST)
        if not item.passed:
            SubElement(
                case, "failure", {"message": observed, "type": "expectation"}
            ).text = f"{printable(item.about)}: {name}; found {observed}"
    indent(root)
    document: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return document


def write_junit(
    path: Path, results: Sequence[CheckResult], names: tuple[str, str, str], seconds: float = 0.0
) -> None:
    """Write results as JUnit XML; see ``junit``.

    Raises:
        CaptureError: the file cannot be written.
    """
    write_bytes(path, junit(results, names, seconds), folders=True)
