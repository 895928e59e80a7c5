"""``edoras help`` and the manual pages."""

import shutil
import subprocess

import pytest

from edoras_tools.cli.help import page


def test_help_of_a_command_is_all_of_it(call):
    short, whole = call("record", "--help").out, call("help", "record").out
    assert "Keep only the newest 5 or 20G" in whole
    assert "Only packets that" not in short
    assert set(short.splitlines()[: short.splitlines().index("Options:")]) <= set(whole.splitlines())
    assert call("help").out == call("help", "all").out
    assert "edoras wireshark extcap install" in call("help", "wireshark", "extcap", "install").out


@pytest.mark.parametrize(("name", "options"), [("info", "-q, -v"), ("sniff", "-v"), ("decode", "-v")])
def test_the_last_line_has_options_that_the_command_takes(name, options, call):
    assert call(name, "-h").out.splitlines()[-1] == f"Also: {options}, --color WHEN"


def test_an_unknown_command(call):
    done = call("help", "recrd")
    assert done.code == 2
    assert done.err == ["edoras: edoras has no command 'recrd'; did you mean record or recover?"]
    assert call("help", "wireshark", "path", "x").code == 2


@pytest.mark.long
def test_manual_pages_are_roff_without_warnings(call, tmp_path):
    done = call("help", "--man", tmp_path / "man1")
    pages = sorted((tmp_path / "man1").iterdir())
    assert f"{len(pages)} manual pages" in done.out
    assert {"edoras.1", "edoras-record.1", "edoras-wireshark-run.1"} <= {path.name for path in pages}
    groff = shutil.which("groff")
    if groff is None:
        pytest.skip("groff is not installed")
    for path in pages:
        told = subprocess.run(
            [groff, "-ww", "-man", "-Tascii", "-P-cbou", path], capture_output=True, text=True, check=True
        )
        assert told.stderr == ""
        assert path.stem.upper() in told.stdout
    assert (
        "--split <amount>"
        in subprocess.run(
            [groff, "-man", "-Tascii", "-P-cbou", tmp_path / "man1/edoras-record.1"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    )


def test_text_is_no_request_of_roff():
    class Command:
        help = ".so /etc/passwd\n\n'tis a \\backslash"
        params = ()

        def get_params(self, _):
            return []

        def collect_usage_pieces(self, _):
            return []

    class Context:
        command_path, parent = "edoras x", None

    lines = page(Command(), Context()).splitlines()
    assert "\\&.so /etc/passwd" in lines
    assert "\\&'tis a \\ebackslash" in lines
