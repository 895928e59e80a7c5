"""What a proxy is told to do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from edoras_tools.errors import ConfigError
from edoras_tools.model import Link
from edoras_tools.sessions.fault_rules import make_rule
from edoras_tools.sessions.faults import FaultPlan
from edoras_tools.sources.sockaddr import comes_in

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.fault_rules import Rule


@dataclass(frozen=True, slots=True)
class ProxyPlan:
    """What is relayed where.

    Attributes:
        link: what the datagrams are taken for.
        listen: where clients send to; of TO the client is cFS itself.
        targets: where it all goes; each gets everything.
        bind: where the target sends to, for one that does not answer to where it was spoken to from, as an
            SBN peer; then there is one client, whoever spoke last.
        client: who gets what the target sends before anybody has spoken; needs ``bind``.
        faults: what goes wrong on purpose.
        idle_ns: a client that nothing came from or went to for so long is forgotten.
        clients: how many are remembered.
        queue_bytes: what may wait where a socket is full.

    Raises:
        ConfigError: there is no target, ``bind`` and the others do not go together, or it sends to itself.
    """

    link: Link
    listen: Endpoint
    targets: tuple[Endpoint, ...]
    bind: Endpoint | None = None
    client: Endpoint | None = None
    faults: FaultPlan = field(default_factory=FaultPlan)
    idle_ns: int = 60_000_000_000
    clients: int = 256
    queue_bytes: int = 4 << 20

    def __post_init__(self) -> None:
        """Check once."""
        if not self.targets:
            raise ConfigError("--target is missing: name where the datagrams go, as 127.0.0.1:1234")
        if self.bind and len(self.targets) > 1:
            raise ConfigError("--bind takes a single target: leave --to out")
        if self.client and not self.bind:
            raise ConfigError("--client needs --bind: without a port of its own no target can speak first")
        for target in self.targets:
            _check_circle("--target", target, "--listen", self.listen)
            if self.bind:
                _check_circle("--target", target, "--bind", self.bind)
        if self.client:
            _check_circle("--client", self.client, "--listen", self.listen)

    @property
    def to_cfs(self) -> bool:
        """Whether the targets are cFS: of TO they are the ground."""
        return self.link is not Link.TO

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
    if comes_in(to, at):
        raise ConfigError(
            f"{sent} {to} is {heard} {at} itself: datagrams would go in a circle; give one another port"
        )


def limit_rule(text: str, mission: Mission) -> Rule:
    """Read a rate limit: ``30``, ``/cmd_vel=30``, ``0x1827=30,latest``, ``all=100``.

    Raises:
        ConfigError: it is none.
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
            *(f"--limit {text}: {what}; write 30, /cmd_vel=30,latest or all=100" for _, what in mistakes)
        )
    return rule


def as_relayed(settings: Settings, link: Link, target: Endpoint) -> Settings:
    """Return the settings that take datagrams to and from a target for those of a link, whatever its port."""
    options = settings.options
    return replace(settings, options=replace(options, ports=(*options.ports, (link, target.port))))
