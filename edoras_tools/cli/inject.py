"""``edoras inject``: sends one message or command, once or at a rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Argument, BadParameter, Context, Option, echo

from edoras_tools.cli import options, sending
from edoras_tools.cli.options import grouped
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.pipelines.sending.inject import Injection


def hexadecimal(text: str) -> bytes:
    """Read bytes in hex; spaces and colons may separate them."""
    try:
        return bytes.fromhex(text.removeprefix("0x").replace(":", " "))
    except ValueError:
        raise BadParameter(f"{text!r} is not bytes in hex; write '01 ff' or 01ff") from None


def _named_commands(incomplete: str) -> list[str]:
    from edoras_tools.pipelines.sending.inject import command_names

    return [name for name in ["list", *command_names()] if name.startswith(incomplete)]


def _named_arguments(ctx: Context, incomplete: str) -> list[str]:
    """Return the arguments of the command that may follow, or the values of the one that is begun."""
    from edoras_tools.cfs.commands import CALLS, arguments_taken

    name = str(ctx.params.get("what") or "")
    if name not in CALLS:
        return []
    label, equals, _ = incomplete.partition("=")
    arguments = arguments_taken(name)
    if equals:
        enumerated = [item for item in arguments if item.name == label and "|" in item.takes]
        words = [f"{label}={value}" for item in enumerated for value in item.takes.split("|")]
    else:
        words = [f"{item.name}=" for item in arguments]
    return [word for word in words if word.startswith(incomplete)]


class MessageOptions(NamedTuple):
    """The message or command to send."""

    what: Annotated[
        str,
        Argument(metavar="[WHAT]", help="A topic, or a command; list: all.", autocompletion=_named_commands),
    ] = ""
    values: Annotated[
        list[str] | None,
        Argument(
            metavar="[MESSAGE]...", help="YAML, @FILE, random; NAME=VALUE.", autocompletion=_named_arguments
        ),
    ] = None
    to: Annotated[
        str, Option(metavar="LINK", help="ci, sbn, ground, LINK or LINK:up; default: the route's.")
    ] = ""
    command: Annotated[tuple[str, str] | None, Option(metavar="MSGID CODE", help="Send a command.")] = None
    payload: Annotated[
        Any, Option("--hex", parser=hexadecimal, metavar="BYTES", help="Bytes after the header of --command.")
    ] = None
    code: Annotated[int | None, Option(parser=options.number, help="Function code of a message.")] = None
    rate: Annotated[float | None, Option(parser=sending.factor, metavar="HZ", help="Times a second.")] = None
    times: Annotated[
        int | None,
        Option("--count", "-n", parser=options.count, help="How often; default 1, with --rate no end."),
    ] = None
    arbitrary: Annotated[bool, Option("--every-field-random", hidden=True)] = False
    limit: Annotated[int | None, Option(min=1, max=255, help="to-add: may wait; default 4.")] = None

    def injection(self, seed: int) -> Injection:
        """Return these options in the form that pipelines take.

        Args:
            seed: seed of the random values.

        Raises:
            ConfigError: no message or command is given, or more than one.
            typer.BadParameter: a MsgId or a code is not a number.
        """
        from edoras_tools.pipelines.sending.inject import Injection

        if bool(self.what) == bool(self.command):
            raise ConfigError("name one thing: a topic, a command's name, or --command MSGID CODE")
        if self.payload is not None and not self.command:
            raise ConfigError("--hex gives the bytes after the header of --command; name --command too")
        words = tuple(self.values or ())
        text = " ".join(words)
        is_random = text == "random"
        return Injection(
            self.what,
            "" if is_random else text,
            (options.msg_id(self.command[0]), options.number(self.command[1])) if self.command else None,
            self.payload or b"",
            1 if self.code is None else self.code,
            self.times or (0 if self.rate else 1),
            self.arbitrary or is_random,
            seed,
            self.limit,
            words,
        )


@grouped
def inject(
    message: MessageOptions,
    ending: sending.EndingOptions,
    how: sending.SendingOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Send one ROS message or one command, once or at a rate.

    For example: edoras inject /cmd_vel '{linear: {x: 0.5}}' -c rover.yaml --rate 10 -n 50
    """
    from edoras_tools.pipelines.sending.inject import described_commands, injection_receiver, make
    from edoras_tools.pipelines.sending.options import receiver
    from edoras_tools.pipelines.sending.run import Transmission
    from edoras_tools.sessions.outgoing import Changes

    if message.what == "list":
        echo(described_commands(*(message.values or ())[:1]))
        return
    send_options, faults = how.send_options(), how.faults.plan()
    injection = message.injection(faults.seed)
    bench = decoding.settings().workbench()
    to, target = receiver(message.to or injection_receiver(injection, bench.mission), bench.columns.context)
    send_options = replace(
        send_options,
        to=to,
        target=send_options.target or target,
        rates=(("*", message.rate or 1.0),),
        headers=bench.columns.context.options.headers or send_options.headers,
    ).placed(bench.mission)
    loaded, send_options = make(injection, bench, send_options)
    changes = Changes(sequence=send_options.sequence, checksum=send_options.checksum)
    transmission = Transmission.of(loaded, send_options, bench.mission, changes)
    sending.carry_out(transmission, bench, faults, ending)
