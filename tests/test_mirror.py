"""Every source file has its test: at the place that mirrors it, or at the one that is named here."""

from __future__ import annotations

from fnmatch import fnmatchcase

from places import ROOT

PACKAGE = ROOT / "edoras_tools"
TESTS = ROOT / "tests"

NO_BEHAVIOUR = (
    *("units.py", "__main__.py", "cfs/command_ingest.py", "cfs/edoras_app.py", "cfs/executive_services.py"),
    *("cfs/names.py", "cfs/sbn.py", "cfs/software_bus.py", "cfs/telemetry_output.py"),
    *("cfs/table_services.py", "cfs/time_services.py", "links/protocol.py"),
)
"""Constants, types and protocols: what uses them is tested."""

ELSEWHERE = {
    "doctor.py": "docs/test_pages.py",
    "errors.py": "wire/test_headers.py",
    "model.py": "decode/test_agreement.py",
    "addons/lab/cli.py": "cli/test_bad_input.py",
    "addons/lab/demo/*": "addons/lab/demo/test_parts.py",
    "addons/lab/emulator/*": "addons/lab/emulator/test_simulation.py",
    "addons/lab/emulator/apps/*": "addons/lab/emulator/test_captures.py",
    "addons/tui/*": "addons/tui/test_viewer.py",
    "addons/tui/cli.py": "addons/tui/test_command.py",
    "addons/tui/lists/*": "addons/tui/test_viewer.py",
    "addons/archive/*": "addons/archive/test_update.py",
    "addons/cfdp/*": "addons/cfdp/test_cli.py",
    "addons/runs/*": "addons/runs/test_check.py",
    "addons/frames/*": "diagnosis/test_rules.py",
    "addons/proxy/*": "addons/proxy/test_run.py",
    "addons/report/*": "cli/test_doctor.py",
    "addons/ros_verbs/rclpy_node.py": "addons/ros_verbs/test_ros.py",
    "addons/rtps/*": "addons/rtps/test_reader.py",
    "addons/trace/*": "addons/trace/test_cli.py",
    "addons/wireshark/cli/*": "addons/wireshark/test_program.py",
    "addons/codegen/ground.py": "addons/codegen/ground/test_xtce.py",
    "cli/*": "cli/test_bad_input.py",
    "decode/*": "decode/test_agreement.py",
    "decode/filters/*": "decode/filters/test_agreement.py",
    "diagnosis/*": "diagnosis/test_captures.py",
    "diagnosis/accounting/*": "diagnosis/test_captures.py",
    "diagnosis/evidence/*": "diagnosis/test_parts.py",
    "diagnosis/evidence/clocks/*": "diagnosis/test_parts.py",
    "diagnosis/evidence/timeline/*": "diagnosis/evidence/timeline/test_timeline.py",
    "diagnosis/matching/*": "diagnosis/test_parts.py",
    "diagnosis/rules/*": "diagnosis/test_rules.py",
    "io/formats/mcap/recovery/*": "io/formats/mcap/test_recover.py",
    "links/*": "decode/test_agreement.py",
    "mission/*": "mission/test_mistakes.py",
    "pipelines/sending/*": "pipelines/sending/test_replay.py",
    "io/formats/cfe.py": "cli/test_cfe_files.py",
    "render/doctor.py": "cli/test_doctor.py",
    "render/pages.py": "addons/report/test_charts.py",
    "render/terminal/*": "render/terminal/test_text.py",
    "ros/cdr/*": "ros/test_against_rosbags.py",
    "sessions/faults/*": "sessions/faults/test_machine.py",
    "structs/*": "structs/test_cfe.py",
    "addons/debug_info/*": "addons/debug_info/test_dwarf.py",
    "wire/*": "wire/test_headers.py",
}
"""Files whose behaviour shows only together with others', and the test that asks them together."""


def sources():
    return sorted(
        path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"
    )


def mirrored(source):
    folder, _, name = source.rpartition("/")
    return (TESTS / folder / f"test_{name}").exists()


def elsewhere(source):
    """Return the pattern that names a file: the file itself, or its folder."""
    folder = source.rpartition("/")[0]
    return next((item for item in (source, f"{folder}/*" if folder else source) if item in ELSEWHERE), None)


def test_every_file_has_its_test():
    without = [
        item for item in sources() if not mirrored(item) and item not in NO_BEHAVIOUR and not elsewhere(item)
    ]
    assert without == []


def test_what_is_named_here_is_there():
    assert [item for item in NO_BEHAVIOUR if not (PACKAGE / item).is_file()] == []
    assert [item for item in ELSEWHERE.values() if not (TESTS / item).is_file()] == []


def test_nothing_is_named_that_need_not_be():
    alone = [item for item in sources() if not mirrored(item) and item not in NO_BEHAVIOUR]
    assert [item for item in NO_BEHAVIOUR if mirrored(item)] == []
    needless = [
        pattern
        for pattern in ELSEWHERE
        if not any(fnmatchcase(item, pattern) and elsewhere(item) == pattern for item in alone)
    ]
    assert needless == []
