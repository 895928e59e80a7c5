"""Results as JUnit XML, which continuous integration reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from edoras_tools.io.outputs import write_bytes
from edoras_tools.mission.report import printable

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.addons.runs.check import CheckReport

_LONGEST: Final = 4000
"""Characters of a text; also, control characters are escaped, which XML cannot hold."""


def junit(report: CheckReport) -> bytes:
    """Return a report as JUnit XML: a test case for each expectation, named as in the file."""
    counts = {"tests": str(len(report.results)), "failures": str(report.failed)}
    root = Element("testsuites", {"name": "edoras check", **counts, "errors": "0"})
    suite = SubElement(
        root,
        "testsuite",
        {
            "name": printable(report.file, _LONGEST),
            **counts,
            "errors": "0",
            "skipped": "0",
            "time": f"{report.seconds:.3f}",
        },
    )
    source = {"name": "source", "value": printable(report.source, _LONGEST)}
    SubElement(SubElement(suite, "properties"), "property", source)
    for item in report.results:
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


def write_junit(report: CheckReport, path: Path) -> None:
    """Write a report as JUnit XML.

    Raises:
        CaptureError: the file cannot be written.
    """
    write_bytes(path, junit(report), folders=True)
