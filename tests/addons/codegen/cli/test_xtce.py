"""``edoras xtce``: what it writes and says."""

from places import MISSIONS


def test_it_writes_a_new_file(call, tmp_path):
    path = tmp_path / "new/rover.xml"
    done = call("xtce", "-c", MISSIONS / "rover_ground.yaml", "-o", path)
    assert (done.code, done.out) == (0, "")
    assert done.err == [f"edoras: {path}: 12 telemetry packets, 108 commands"]
    assert path.read_text().startswith('<?xml version="1.0" encoding="UTF-8"?>')
    assert call("xtce", "-c", MISSIONS / "rover_ground.yaml", "-o", path).code == 2


def test_telemetry_and_commands_for_cosmos(call):
    text = call("xtce", "-c", MISSIONS / "rover_ground.yaml", "--format", "cosmos", "--system", "rover").out
    assert "TELEMETRY ROVER TELEMETRY_POSE_6 LITTLE_ENDIAN" in text
    assert "COMMAND ROVER CMD_VEL LITTLE_ENDIAN" in text


def test_what_varies_is_told(call, tmp_path):
    done = call("xtce", "-c", MISSIONS / "single_arm_ground.yaml", "-o", tmp_path / "arm.xml")
    assert done.code == 0
    assert any("described up to a field whose place varies too much" in line for line in done.err)
