"""What a mission file says of the flight software: read, refused, and whose word counts."""

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.mission import loads
from edoras_tools.pipelines.workbench import Settings

FORM = "system: {{ros__parameters: {{cfs: {{{}}}}}}}"


def read(text):
    return loads({"system.yaml": FORM.format(text).encode()}).software


def test_constants_limits_and_headers_are_read():
    software = read("ci_wake_ns: 250000000, app_msg_limit: 2, to_limits: {0x0A01: 20}, extended_header: true")
    assert (software.profile.ci_wake_ns, software.profile.app_msg_limit) == (250_000_000, 2)
    assert (software.profile.to_limits[0x0A01], software.profile.to_limits[0x0808]) == (20, 32)
    assert software.profile.stated == {"ci_wake_ns", "app_msg_limit", 0x0A01}
    assert software.headers == {"extended_header": True}
    assert read('time: "1/1000 s, since 2000-01-01"').headers == {
        "time": "1/1000 s, since 2000-01-01T00:00:00"
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("ci_wake: 5", "cfs.ci_wake: not known; did you mean ci_wake_ns"),
        ("app_msg_limit: two", "cfs.app_msg_limit: "),
        ("ci_wake_ns: 0", "ci_wake_ns: 0 is not allowed; 1 or more"),
        ("telemetry_header: 13", "12 or 16 is needed"),
        ("to_limits: {pose: 4}", "cfs.to_limits.pose: not a MsgId; write 0x0827: 4"),
        ("to_limits: {0x0827: 256}", "256 is out of range"),
        ("ports: 5010", "a list of keys is needed"),
        ('time: "1/0 s"', "cfs.time: time '1/0 s' is not known; in this order some of"),
        ("time: 5", "cfs.time: "),
    ],
)
def test_a_mistake_is_said(text, problem):
    with pytest.raises(ConfigError, match=problem):
        read(text)


def test_there_is_one_cfs():
    files = {
        name: FORM.format("app_msg_limit: 2").encode() + number for name, number in (("a", b""), ("b", b"\n"))
    }
    with pytest.raises(ConfigError, match="another one; a mission has one cFS"):
        loads(files)


def test_headers_and_ports_are_those_of_the_file_and_the_command_line_says_more(tmp_path):
    path = tmp_path / "system.yaml"
    path.write_text(FORM.format('msg_id_version: 2, ports: ["ci:5010"], app_msg_limit: 2'))
    bench = Settings([path], constants={"app_msg_limit": 3}).workbench()
    context = bench.columns.context
    assert (context.headers.msg_ids.version, bench.mission.msg_ids.version) == (2, 2)
    assert 5010 in context.capture_ports()
    assert bench.mission.software.profile.app_msg_limit == 3
