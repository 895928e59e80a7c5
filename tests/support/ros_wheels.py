"""Real ROS 2, Jazzy and Kilted, from their wheels, which ``make ros`` installs below ``.ros``."""

import json
import os
import subprocess

import pytest
from places import ROOT, SUPPORT
from waiting import PATIENCE_S

HOME = ROOT / ".ros"
DISTROS = ("jazzy", "kilted")


def distro(name, *marks):
    """Return a distribution as a parameter: its test is skipped where its wheels are not installed."""
    if (HOME / name / ".installed").exists():
        return pytest.param(name, marks=marks)
    absent = HOME / f"{name}.absent"
    why = absent.read_text().strip() if absent.exists() else f"ROS 2 {name} is not installed: make ros"
    return pytest.param(name, marks=pytest.mark.skip(reason=why))


INSTALLED = [distro(name) for name in DISTROS]
APART = [distro(name, pytest.mark.own_network) for name in DISTROS]


def python(name):
    return HOME / name / "bin/python"


def asked(distro, cases):
    """Return what ``ros_names.py`` says of cases."""
    command = [python(distro), SUPPORT / "ros_names.py"]
    done = subprocess.run(
        command, input=json.dumps(cases), capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


class Talk:
    """A real node that does what it is asked, see ``ros_talk.py``; in a ``with``, which ends it."""

    def __init__(self, distro, **variables):
        environ = (
            os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "14"} | variables
        )
        self.process = subprocess.Popen(
            [python(distro), SUPPORT / "ros_talk.py"],
            env=environ,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout.readline() == "{}\n"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.communicate(timeout=PATIENCE_S)

    def tell(self, **order):
        """Have an order done; return the answer."""
        self.begin(**order)
        return self.answer()

    def begin(self, **order):
        """Give an order."""
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()

    def answer(self):
        """Wait until the oldest order is done; return its answer."""
        return json.loads(self.process.stdout.readline())
