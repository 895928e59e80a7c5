"""The settings of a proxy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.io.net.sockets import arrives_at
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import Rule, make_rule
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.pipelines.workbench import Settings


class ProxyPlan(msgspec.Struct, frozen=True):
    """The settings of a relay.

    Attributes:
        link: the link of the datagrams.
        listen: address that clients send to; for TO the client is cFS.
        targets: each target gets every datagram.
        bind: address that the target sends to, if it does not answer to the sender's port (an SBN peer); then
            there is one client, the last that sent.
        client: receiver of the target's datagrams before any client has sent; needs ``bind``.
        faults: the faults to inject.
        idle_ns: time without traffic after which a client is removed, ns.
        clients: maximum number of clients.
        queue_bytes: maximum bytes that wait while a socket's buffer is full.
        headers: headers of the cFE, for faults that depend on them.

    Raises:
        ConfigError: there is no target, ``bind`` cannot be combined with the others, or it sends to itself.
    """

    link: Link
    listen: Endpoint
    targets: tuple[Endpoint, ...]
    bind: Endpoint | None = None
    client: Endpoint | None = None
    faults: FaultPlan = msgspec.field(default_factory=FaultPlan)
    idle_ns: int = 60_000_000_000
    clients: int = 256
    queue_bytes: int = 4 << 20
    headers: Headers = STANDARD

    def __post_init__(self) -> None:
        """Check the combination."""
        if not self.targets:
            raise ConfigError("--target is missing: name where the datagrams go, e.g. 127.0.0.1:1234")
        if self.bind and len(self.targets) > 1:
            raise ConfigError("--bind can only be used with one target: leave --to out")
        if self.client and not self.bind:
            raise ConfigError("--client needs --bind: otherwise no target can send before a client")
        for target in self.targets:
            _check_circle("--target", target, "--listen", self.listen)
            if self.bind:
                _check_circle("--target", target, "--bind", self.bind)
        if self.client:
            _check_circle("--client", self.client, "--listen", self.listen)

    @property
    def to_cfs(self) -> bool:
        """Whether the targets are cFS; for TO they are the ground."""
        return not self.link.only_from_cfs

    def summary(self) -> dict[str, Any]:
        """Return the plan's part of ``proxy --json``."""
        return {
            "link": self.link.label,
            "listen": str(self.listen),
            "targets": [str(target) for target in self.targets],
            "bind": str(self.bind) if self.bind else None,
            "seed": self.faults.seed,
            "faults": [
                {"rule": rule.text, "kind": rule.kind.name, "on": rule.enabled, "struck": 0}
                for rule in self.faults.rules
            ],
        }


def _check_circle(sent: str, to: Endpoint, heard: str, at: Endpoint) -> None:
    if arrives_at(to, at):
        raise ConfigError(
            f"{sent} {to} is {heard} {at} itself: datagrams would be sent in a loop; change one of the ports"
        )


def limit_rule(text: str, mission: Mission) -> Rule:
    """Read a rate limit: ``30``, ``/cmd_vel=30``, ``0x1827=30,latest``, ``all=100``.

    Raises:
        ConfigError: it is not a rate limit.
        RouteError: the topic is not configured.
    """
    route, equals, rest = text.rpartition("=")
    rate, _, keep = rest.partition(",")
    words: list[tuple[str, str | None]] = [("", rate)]
    if keep:
        words.append(("keep", keep))
    if route == "all":
        words.append(("per", "link"))
    elif equals:
        words.append(("msg_id", route if route[:2].lower() == "0x" else hex(mission.find(route).msg_id)))
    written = ",".join([f"rate:{rate}", *(f"{name}={value}" for name, value in words[1:])])
    rule, mistakes = make_rule("rate", words, written)
    if rule is None:
        raise ConfigError(
            *(
                f"--limit {text}: {problem}; write 30, /cmd_vel=30,latest or all=100"
                for _, problem in mistakes
            )
        )
    return rule


def as_relayed(settings: Settings, link: Link, target: Endpoint) -> Settings:
    """Return settings that assign the target's port to a link, whatever port it is."""
    options = settings.options
    return replace(settings, options=replace(options, ports=(*options.ports, (link, target.port))))
