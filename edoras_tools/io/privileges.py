"""Dropping root's privileges for good, once everything that needs them is open.

A packet socket needs them when it is created, not when it is bound or read: an open socket continues to
work, and can be bound again.
"""

from __future__ import annotations

import ctypes
import os
import pwd
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.errors import CaptureError, ConfigError

if TYPE_CHECKING:
    from pathlib import Path

_PR_SET_NO_NEW_PRIVS: Final = 38


class User(NamedTuple):
    """The account that a process changes to.

    Attributes:
        name: name of the account.
        uid: user id.
        gid: primary group id.
        groups: ids of all its groups.
    """

    name: str
    uid: int
    gid: int
    groups: tuple[int, ...]


def find_user(name: str) -> User:
    """Return an account that this process can change to.

    Raises:
        ConfigError: the name is unknown, the account is root, or this process is not root.
    """
    try:
        entry = pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(f"--user {name}: no such account; 'getent passwd' lists them") from None
    if entry.pw_uid == 0:
        raise ConfigError(f"--user {name}: that is root; name an unprivileged account, e.g. nobody")
    if os.geteuid() != 0:
        raise ConfigError(f"--user {name}: only root can change to another user; leave it out, or use sudo")
    groups = tuple(os.getgrouplist(entry.pw_name, entry.pw_gid))
    return User(entry.pw_name, entry.pw_uid, entry.pw_gid, groups)


def check_writable(user: User, folder: Path) -> None:
    """Check that an account can create files in a folder, by creating one and deleting it.

    If the folder does not exist yet, its first existing parent is checked. No other thread may depend on the
    user id during the call.

    Raises:
        CaptureError: it cannot create files there.
    """
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with _as(user), tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise CaptureError(
            f"{folder}: {user.name} cannot write there: {error.strerror or error}; "
            f"'chown {user.name} {folder}', or name a folder of {user.name}'s with -o"
        ) from error


def check_readable(user: User, *files: Path) -> None:
    """Check that an account can read these files, e.g. modules that are loaded later.

    Raises:
        CaptureError: it cannot read one.
    """
    for file in files:
        try:
            with _as(user), file.open("rb"):
                pass
        except OSError as error:
            raise CaptureError(
                f"--user {user.name}: {user.name} cannot read this program: {file}: "
                f"{error.strerror or error}; install it where all users can read it, e.g. in /opt"
            ) from error


def forbid_new_privileges() -> None:
    """Let no program that is started get more privileges than this one (Linux: ``no_new_privs``).

    It holds for the calling thread and for threads that are started later.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)


def become(user: User) -> None:
    """Drop root's privileges for good, in all threads.

    Raises:
        CaptureError: privileges cannot be dropped, or could be regained.
    """
    try:
        os.setgroups(user.groups)
        os.setresgid(user.gid, user.gid, user.gid)
        os.setresuid(user.uid, user.uid, user.uid)
    except OSError as error:
        why = error.strerror or error
        raise CaptureError(f"--user {user.name}: root privileges cannot be dropped: {why}") from error
    try:
        os.setuid(0)
    except OSError:
        return
    raise CaptureError(f"--user {user.name}: root privileges can be regained; nothing is captured")


@contextmanager
def _as(user: User) -> Iterator[None]:
    """Access files as another user inside the block."""
    groups, gid, uid = os.getgroups(), os.getegid(), os.geteuid()
    try:
        os.setgroups(user.groups)
        os.setegid(user.gid)
        os.seteuid(user.uid)
        yield
    finally:
        os.seteuid(uid)
        os.setegid(gid)
        os.setgroups(groups)
