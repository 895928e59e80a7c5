"""The rules: a function each that goes through a case and yields verdicts, which get its name.

They are asked in this order, what concerns the capture itself first. ``docs/rules`` has a section for each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools import doors
from edoras_tools.diagnosis.rules import (
    capture,
    commands,
    content,
    flight_software,
    gaps,
    messages,
    network,
    output,
    pipes,
    silence,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

    Rule = Callable[[Case], Iterator[Verdict]]

RULES: Final[dict[str, Rule]] = {
    rule.__name__: rule
    for rule in (
        capture.not_examined,
        capture.more_senders,
        capture.capture_drops,
        pipes.host_drops,
        capture.cut_frames,
        capture.stream_gap,
        capture.not_cfs,
        capture.captured_twice,
        capture.out_of_order,
        capture.duplicated,
        capture.clock_jump,
        capture.proxy_faults,
        flight_software.cfs_restart,
        flight_software.cfs_stalled,
        flight_software.not_observable,
        pipes.lost_before_ci,
        pipes.ci_backlog,
        pipes.app_outage,
        pipes.app_pipe_limit,
        pipes.app_pipe_overflow,
        pipes.to_message_limit,
        pipes.to_pipe_overflow,
        pipes.sbn_peer_pipe,
        gaps.crossing_loss,
        gaps.lost_after_cfs,
        network.damaged,
        gaps.perhaps_lost,
        gaps.unexplained_gap,
        gaps.unattributed_loss,
        messages.struct_overrun,
        content.changed_values,
        content.old_values,
        content.old_states,
        content.value_limits,
        silence.topic_silent,
        pipes.ci_cut,
        messages.ground_bridge_buffer,
        messages.flight_bridge_length,
        commands.bad_command,
        messages.no_subscriber,
        messages.rate_over_limit,
        gaps.port_closed,
        gaps.unreachable,
        network.sbn_timeout,
        network.sbn_peer_restart,
        network.sbn_tcp_overwritten,
        network.sbn_never_connected,
        network.sbn_disconnected,
        network.bad_network_message,
        network.wrong_ident,
        network.wrong_protocol_version,
        network.unknown_peer,
        network.sbn_table,
        output.to_not_enabled,
        output.to_destination,
        output.to_stopped,
        messages.wrong_direction,
        messages.wrong_type,
        messages.topic_never_seen,
        messages.not_configured,
        gaps.older_losses,
        flight_software.event_suppression,
        flight_software.event_squelch,
        commands.stranger_commands,
        commands.identity_from_two_addresses,
        commands.repeated_commands,
        commands.privileged_commands,
        output.to_taken_over,
        commands.checksum,
        network.subscription_storm,
        network.proto_storm,
        gaps.superseded,
        flight_software.cfs_errors,
    )
}
"""Those of the core, by the name that their verdicts carry."""


def of_addons() -> dict[str, Rule]:
    """Return the rules of the add-ons that are here; those are about what links saw themselves."""
    return {name: item.load() for name, item in doors.shipped("rules").items() if not item.absent}


def shipped_rules() -> dict[str, Rule]:
    """Return the rules of the core and of the add-ons that are here."""
    return RULES | of_addons()


def others() -> list[Rule]:
    """Return the rules that are not about the rows of a case: a capture may hold nothing else."""
    return [capture.not_examined, capture.not_cfs, *of_addons().values()]


def rules() -> dict[str, Rule]:
    """Return all rules, by the name that their verdicts carry: those that installed packages add come last.

    Raises:
        ConfigError: a package's rule cannot be loaded, or its name is taken.
    """
    result = shipped_rules()
    for item in doors.installed("rules"):
        if item.name in result:
            raise item.error("another rule has this name; uninstall one of them")
        result[item.name] = item.load()
    return result


SINGLE: Final = frozenset(
    {
        *("struct_overrun", "ci_cut", "ground_bridge_buffer", "flight_bridge_length", "bad_command"),
        *("no_subscriber", "bad_network_message", "wrong_ident", "wrong_protocol_version", "unknown_peer"),
        *("wrong_type", "host_drops"),
    }
)
"""Rules about messages that come to nothing by what they are; asked first: the balance has their figures."""
