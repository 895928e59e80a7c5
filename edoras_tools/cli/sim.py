"""``edoras sim``: the emulated cFS."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from edoras_tools.cli import options


def sim() -> None:
    """Run an emulated cFS on loopback: CI, TO, SBN and a robot app, with the limits of the real one."""
