"""``edoras``: all commands, their help texts, and the exit codes and messages when one fails.

Help texts have click's style, on one screen: ``-h`` names options that ``edoras help COMMAND`` explains.
Typer would draw them with rich, which takes longer to import than all the rest of ``--help``; and neither has
a short form. So two methods replace Typer's: below ``-h``, options that belong together share one line, and
commands stand in their groups.
"""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from importlib import import_module
from io import TextIOWrapper
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any, Final, NoReturn

import typer
import typer.core

from edoras_tools import __version__, doors
from edoras_tools.cli import settings
from edoras_tools.cli.options import OLD_NAMES, QUIET, VERBOSE
from edoras_tools.cli.output import INTERRUPTED, tell
from edoras_tools.errors import ConfigError, EdorasError

OWN: Final = "Options"
"""Heading of a command's own options."""
WHOLE: Final = "edoras.whole"
"""Key of a context's ``meta``: all options are explained."""
_TYPE: Final = re.compile(r"<([\w ]+)>")
_VALUES: Final = {"str": "text", "int range": "number", "float range": "number", "recording_path": "path"}
"""Name of a parser to its name in help texts; other parsers keep their names."""


def sections(command: Any, ctx: Any) -> Mapping[str, list[tuple[str, str]]]:
    """Return the names and texts of a command's parameters by heading, its own heading first."""
    rows: dict[str, list[tuple[str, str]]] = {OWN: []}
    for item in command.get_params(ctx):
        if record := item.get_help_record(ctx):  # a hidden parameter has none
            names, text = record
            names = _TYPE.sub(lambda match: _VALUES.get(match[1], match[1]).upper(), names)
            text = text.removesuffix("  [default: True]")  # of a switch that only has its no
            heading = getattr(item, "rich_help_panel", None) or OWN
            if getattr(item, "multiple", False):
                text = f"{text.removesuffix('.')}; repeatable."
            rows.setdefault(heading, []).append((names.lstrip(" /"), text))  # "/ --no-x" of one for no alone
    return rows


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write a command's parameters; without full help, those under a heading are only named."""
    whole, summaries = ctx.meta.get(WHOLE, False), []
    for heading, rows in sections(command, ctx).items():
        if whole or (heading == OWN and not hasattr(command, "commands")):
            with formatter.section(heading):
                formatter.write_dl(rows)
        elif rows:
            summaries.append((heading, ", ".join(names.split(",")[-1].split()[0] for names, _ in rows)))
    if hasattr(command, "commands"):
        _write_commands(command, formatter)
    if summaries:
        root, _, path = ctx.command_path.partition(" ")
        with formatter.section(f"More ({f'{root} help {path}'.strip()} explains)"):
            formatter.write_dl(summaries)
    if not whole and not hasattr(command, "commands"):
        formatter.write_paragraph()
        switches = {"-q", "-v"}.intersection(name for item in command.params for name in item.opts)
        formatter.write_text(f"Also: {', '.join([*sorted(switches), '--color WHEN'])}")


def _write_commands(command: Any, formatter: Any) -> None:
    """Write the commands of a group with their texts; a heading stands in front of its first one."""
    commands = {name: item for name, item in command.commands.items() if not item.hidden}
    rows = []
    column = max(len(item.rich_help_panel or "") for item in commands.values())
    panels = [item.rich_help_panel or "" for item in commands.values()]  # groups of commands come last
    ordered = sorted(commands, key=lambda name: panels.index(commands[name].rich_help_panel or ""))
    for heading, names in groupby(ordered, lambda name: commands[name].rich_help_panel or ""):
        for place, name in enumerate(names):
            rows.append((f"{'' if place else heading:<{column}} {name}".rstrip(), first_line(commands[name])))
    formatter.write_paragraph()
    formatter.write_dl(rows)


def first_line(command: Any) -> str:
    """Return the first sentence about a command."""
    return re.split(r"(?<=\.) ", " ".join((command.help or "").partition("\n\n")[0].split()))[0]


_SETTINGS = {"help_option_names": ["-h", "--help"]}
_USAGE: Final[Any] = typer.BadParameter.__mro__[1]
"""Click's base class of usage errors; some versions of typer contain their own copy of click."""

_VALUE_LEFT_OUT: Final = {"--sync": "--sync=1s", "--clock": "--clock=40"}
"""Options that may stand without their value, which click can and Typer does not pass on (``flag_value``)."""

_NO_MEMORY: Final = (
    *("can't start new thread", "failed to map segment", "Cannot allocate memory"),
    "unknown encoding: idna",  # for any host name: Python could not load its module for host names
    *("without exception set", "without setting an exception"),  # Python cannot create a MemoryError
)
"""Texts of errors other than ``MemoryError`` that mean that memory is exhausted."""

_OF_THE_CORE: Final = {
    "Look": ("sniff", "info", "decode", "host"),
    "Record": ("record", "recover", "export"),
    "Explain": ("doctor",),
    "Send": ("replay", "inject"),
    "Connect": ("bridge",),
    "Try": ("samples", "help"),
}
"""Commands and groups of commands by heading, each in a module of its name."""
_OF_EDORAS: Final = frozenset(
    {"", "-h", "--help", "--version", "--color", "--install-completion", "--show-completion"}
)
"""Options that may stand where a command does."""
_INSTALLED: Final = "Installed"
"""Heading of the commands that other packages add."""


def _groups() -> dict[str, list[str]]:
    """Return the commands that ship, by group."""
    groups = {name: list(commands) for name, commands in _OF_THE_CORE.items()}
    for row in doors.table():
        for name, command in row.commands.items():
            names = groups[command.group]
            names.insert(names.index(command.before) if command.before else len(names), name)
    return groups


GROUPS: Final = _groups()
"""Commands by heading: those of the core and of add-ons, including absent ones."""
COMMANDS: Final = {name: group for group, names in GROUPS.items() for name in names}
"""The group of each command."""


def _show_version(flag: bool) -> None:
    if flag:
        typer.echo(f"edoras-tools {__version__}")
        raise typer.Exit


def _set_colour(when: str | None) -> None:
    """Set the variables that every view asks; see ``render.terminal.terminal``."""
    if when in {"always", "never"}:
        os.environ.pop("FORCE_COLOR", None)
        os.environ.pop("NO_COLOR", None)
        os.environ["FORCE_COLOR" if when == "always" else "NO_COLOR"] = "1"
    elif when not in {"auto", None}:
        raise typer.BadParameter(f"{when!r} is not auto, always or never")


def _eager(name: str, text: str, call: Callable[[Any], None], **keywords: Any) -> Any:
    """Make an option that acts before all others and is not passed to the command."""
    return typer.core.TyperOption(
        param_decls=[name],
        help=text,
        callback=lambda _ctx, _option, value: call(value),
        expose_value=False,
        is_eager=True,
        **keywords,
    )


class Command(typer.core.TyperCommand):
    """A command. ``edoras.toml`` provides defaults of its options; ``--sync`` means ``--sync=1s``."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.params.append(_colour_option(hidden=True))
        self._own_verbose = any("-v" in item.opts for item in self.params)
        if not self._own_verbose:
            self.params.append(_flag("--verbose", "-v", text=VERBOSE, hidden=True))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options into the help text."""
        write_options(self, ctx, formatter)

    def make_parser(self, ctx: Any) -> Any:
        """Return click's parser, which takes old names of options too."""
        parser = super().make_parser(ctx)
        names = {name for item in self.params for name in item.opts}
        for item in self.params:
            now = {*item.opts, *item.secondary_opts}
            for old in [name for name in OLD_NAMES if OLD_NAMES[name] in now and name not in names]:
                alias = copy(item)
                alias.opts, alias.secondary_opts = [old], []
                alias.add_to_parser(parser, ctx)
        return parser

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments."""
        only_help = ctx.resilient_parsing or not {"-h", "--help", "--version"}.isdisjoint(args)
        file = None if only_help or ctx.info_name == "help" else settings.find()
        if file is not None and file.left_out:
            tell(_harmless(f"{file.path} is not used: {file.left_out}"))
        elif file is not None:
            file.check(COMMANDS)
            parameters = {
                name.removeprefix("--"): item
                for item in self.params
                for name in item.opts
                if name.startswith("--")
            }
            options = {name: item.multiple or item.nargs == -1 for name, item in parameters.items()}
            values = file.defaults(_name(ctx), options)
            ctx.default_map = {parameters[name].name: value for name, value in values.items()}
        try:
            rest = super().parse_args(ctx, [_VALUE_LEFT_OUT.get(item, item) for item in args])
        except _USAGE as error:
            option = str(getattr(getattr(error, "param", None), "name", ""))
            if file is not None and option in (ctx.default_map or ()) and not _is_given(ctx, option):
                error.message = f"{file.path}: {error.message}"
            error.ctx = error.ctx or ctx  # click leaves it empty if an option's argument is missing
            raise
        verbose = ctx.params.get("verbose", False)
        if not self._own_verbose:
            ctx.params.pop("verbose", None)  # the command does not know it
        if verbose:
            _print_setup(ctx, file)
        return rest


def _colour_option(**keywords: Any) -> Any:
    text = "Use colours and styles: auto, always or never."
    return _eager("--color", text, _set_colour, metavar="WHEN", **keywords)


def _flag(*names: str, text: str, **keywords: Any) -> Any:
    return typer.core.TyperOption(param_decls=[*names], help=text, is_flag=True, default=False, **keywords)


class _Absent(Command):
    """A command that this installation does not have: it ends with an error, whatever follows its name."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse nothing but a wish for help."""
        return super().parse_args(ctx, [item for item in args if item in {"-h", "--help"}])


class Program(Command):
    """The only command of a program."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.params.append(_version_option())


def _print_setup(ctx: Any, file: settings.SettingsFile | None) -> None:
    """Print the setup of a command: versions, the settings file, missions and the like."""
    python = ".".join(map(str, sys.version_info[:3]))
    used = file.path if file and not file.left_out else f"no {settings.NAME}"
    lines = [f"edoras-tools {__version__}, Python {python}", f"settings: {used}"]
    for name, called in (("config", "missions"), ("msg_path", "messages"), ("structs", "structs")):
        paths = ", ".join(map(str, ctx.params.get(name) or ()))
        lines += [f"{called}: {paths}"] if paths else []
    for line in lines:
        tell(_harmless(line))


def _version_option() -> Any:
    return _eager("--version", "Show the version and exit.", _show_version, is_flag=True)


class Group(typer.core.TyperGroup):
    """Several commands.

    Attributes:
        hides_colour: whether its help text leaves --color out, because that of ``edoras`` has it.
    """

    hides_colour = True

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.params.append(_colour_option(hidden=self.hides_colour))

    format_options = Command.format_options


def command_group(name: str, text: str, kind: type[Group] = Group) -> typer.Typer:
    """Make a group of commands; without a command it prints its help text."""
    return typer.Typer(
        name=name, cls=kind, help=text, no_args_is_help=True, add_completion=False, rich_markup_mode=None
    )


def _is_given(ctx: Any, option: str) -> bool:
    """Whether an option's value comes from the command line or the environment."""
    return getattr(ctx.get_parameter_source(option), "name", "") in {"COMMANDLINE", "ENVIRONMENT"}


def _name(ctx: Any) -> str:
    """Return the name of the running command, also in its own program."""
    names = [ctx.info_name]
    while ctx.parent is not None:
        ctx = ctx.parent
        names.append(ctx.info_name)
    return str(names[-2] if len(names) > 1 else names[0].removeprefix("edoras-"))


class _Edoras(Group):
    """``edoras`` itself."""

    hides_colour = False

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.params.append(_version_option())
        self.params.append(_flag("--quiet", "-q", text=QUIET, expose_value=False, hidden=True))
        self.params.append(_flag("--verbose", "-v", text=VERBOSE, expose_value=False, hidden=True))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; nothing may follow an option about completion, which would ignore it."""
        name, *rest = args or [""]
        if rest and name in {"--install-completion", "--show-completion"} and not ctx.resilient_parsing:
            raise typer.BadParameter(f"{name} takes no value: run it alone, in the shell that it is for")
        return super().parse_args(ctx, args)


def program(*names: str, completes: bool = False) -> typer.Typer:
    """Make the ``edoras`` command line.

    Args:
        names: names of the commands to add; all if empty. Adding a command takes time, and most are not run.
        completes: whether a shell requests completions.
    """
    app = typer.Typer(
        name="edoras",
        cls=_Edoras,
        help="\b\nCapture, decode, record, replay and diagnose ROS 2 through NASA's cFS.\n"
        "Start: edoras FILE, or edoras demo. All of a command: edoras help COMMAND",
        no_args_is_help=True,
        add_completion=completes or not names,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings=_SETTINGS,
    )
    app.callback()(lambda: None)
    for name in names or [*COMMANDS, *(item.name for item in doors.installed("commands"))]:
        command, heading = _command(name), COMMANDS.get(name, _INSTALLED)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=heading)
        elif isinstance(command, ConfigError):
            absent = _absent(name, command)
            app.command(name, cls=_Absent, rich_help_panel=heading)(absent)
        else:
            app.command(name, cls=Command, rich_help_panel=heading)(command)
    return app


def with_command(words: list[str]) -> list[str]:
    """Return a command line with its command: ``doctor`` if it begins with a file, or is empty.

    ``convert A B`` is ``record A -o B``. Commands are made one at a time, so their name must be known before.

    Args:
        words: words after ``edoras``.
    """
    words = _joined(words)
    options = [*takewhile({"-q", "-v", "--quiet", "--verbose"}.__contains__, words)]
    if options and is_command(command := "".join(words[len(options) :][:1])):
        words = [command, *options, *words[len(options) + 1 :]]
    first = words[0] if words else ""
    if first == "convert" and len(words) > 2:
        return ["record", words[1], "-o", *words[2:]]
    if first in _OF_EDORAS or is_command(first):
        return words
    if first.startswith("-") and first != "-":
        is_file = any(Path(item).exists() for item in words[1:])
    else:
        is_file = first == "-" or "." in first or Path(first).exists()
    if is_file and is_command("".join(words[1:])):
        return [words[1], first]  # edoras FILE sniff
    return ["doctor", *words] if is_file else words


def _joined(words: list[str]) -> list[str]:
    """Return a command line where each word from ``--ros-args`` to ``--``, or to the end, is an option."""
    line: list[str] = []
    ros = False
    for word in words:
        if ros and word != "--":
            line.append(f"--ros-args={word}")
        elif ros or word == "--ros-args":
            ros = not ros
        else:
            line.append(word)
    return line


def is_command(word: str) -> bool:
    """Return whether a word is a command; other packages are asked only for words unknown here."""
    return word in COMMANDS or (word[:1].isalpha() and doors.find("commands", word) is not None)


def _command(name: str) -> Any:
    """Return a command, or the error that it is absent or cannot be loaded."""
    item = doors.shipped("commands").get(name)
    if item is None and name in COMMANDS:
        module = import_module(f"edoras_tools.cli.{name}")
        return getattr(module, name, None) or getattr(module, f"{name}_")  # `help` is a word of Python
    item = item or doors.find("commands", name)
    assert item is not None
    try:
        return item.load()
    except ConfigError as error:
        return error


def _absent(name: str, error: ConfigError) -> Callable[[], None]:
    """Return a function that raises an error when its command runs; its help text gives the error."""

    def absent() -> None:
        raise error

    texts = {name: command.help for row in doors.table() for name, command in row.commands.items()}
    absent.__doc__ = f"{texts.get(name, 'Cannot be loaded').removesuffix('.')} (not in this installation)."
    return absent


def alone(name: str) -> typer.Typer:
    """Make a program with one command."""
    app = typer.Typer(
        name=f"edoras-{name}",
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings=_SETTINGS,
    )
    app.command(cls=Program)(_command(name))
    return app


def run(app: typer.Typer) -> NoReturn:
    """Run a command line and return its exit code; an error is one clear line, never a traceback.

    Exit codes: 0 success, 1 failed, 2 usage error, 3 finished but data was lost or found lost, 130 stopped by
    Ctrl-C.
    """
    _open_streams()
    if isinstance(sys.stdout, TextIOWrapper):
        # File names may contain bytes that are not text, and not every terminal can show an arrow.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = app(standalone_mode=False) or 0
        sys.stdout.flush()
    except EdorasError as error:
        code = error.exit_code
        branch = next(item for item in type(error).__mro__ if item.__base__ in {EdorasError, Exception})
        _say(str(error), branch.__name__.removesuffix("Error").lower())
    except _USAGE as error:
        code = error.exit_code
        text = error.format_message().replace("Value error, ", "")  # the prefix of typer's own checks
        text = text.replace("valid float range", "number").replace("valid int range", "whole number")
        command = error.ctx.command_path if error.ctx else app.info.name
        see = f"{' See' if text.endswith('?') else '; see'} {command} -h"
        _say(f"{text.removesuffix('.')}{see}" if text and not text.startswith("Usage: ") else text, "usage")
    except SystemExit as error:
        # click ends like this if the pipe is broken: the reader of the output, such as `head`, has closed it.
        code = 0 if isinstance(error.__context__, BrokenPipeError) else error.code
        _abandon_output()
    except BrokenPipeError:
        code = 0
        _abandon_output()
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
        _abandon_output()
    except (OSError, MemoryError, RuntimeError, SystemError, ImportError, LookupError) as error:
        code = 1
        limit = _limit(error)
        if not limit and not isinstance(error, OSError):
            raise
        # Files and sockets raise EdorasError: this is standard output, or a name that no file can have.
        place = getattr(error, "filename", None) or "standard output cannot be written"
        _say(limit or f"{place}: {getattr(error, 'strerror', None) or error}", "limit" if limit else "output")
        _abandon_output()
    sys.exit(code)


def _limit(error: BaseException) -> str:
    """Return advice for a system without memory or files left; empty for other errors."""
    number, text = getattr(error, "errno", None), str(error)
    if error.__context__ is not None and (limit := _limit(error.__context__)):
        return limit  # the cause of this error
    if number in {errno.EMFILE, errno.ENFILE} or "cannot open shared object file: Error 2" in text:
        return "too many open files: close other programs, or allow more with 'ulimit -n'"
    if isinstance(error, MemoryError) or number == errno.ENOMEM or any(item in text for item in _NO_MEMORY):
        return "out of memory: close other programs, allow more with 'ulimit -v', or read less at a time"
    return ""


def _open_streams() -> None:
    """Open standard streams that the shell closed, as with ``>&-``: Python sets them to None."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115  never closed


def _say(message: str, kind: str) -> None:
    """Print why a command failed; with ``--json`` as JSON."""
    with suppress(OSError):
        if message and "--json" in sys.argv:
            import json

            reason, _, hint = message.rpartition("; ") if "\n" not in message else ("", "", "")
            error = {"code": kind, "message": reason or message, "hint": hint if reason else None}
            sys.stderr.write(json.dumps({"schema": 1, "error": error}, ensure_ascii=True) + "\n")
            return
        start = "" if message.startswith("Usage: ") else "edoras: "  # the help text, where nothing is asked
        for line in message.splitlines():
            sys.stderr.write(f"{start}{_harmless(line)}\n")


def _harmless(line: str) -> str:
    """Return a line without control characters for the terminal: it may contain text from a file."""
    if line.isprintable():  # the import below may fail when there is no memory
        return line
    from edoras_tools.render.terminal.text import clean

    return clean(line)


def _abandon_output() -> None:
    """Stop Python from writing the failed output again at exit."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except OSError:  # no more files
        os.close(1)
