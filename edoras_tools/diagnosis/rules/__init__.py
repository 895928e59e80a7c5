"""The rules: a function each that goes through a case and yields verdicts, which get its name.

They are asked in this order, what concerns the capture itself first. ``docs/rules`` has a section for each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.rules.capture import (
    capture_drops,
    captured_twice,
    clock_jump,
    cut_frames,
    duplicated,
    fprime_packets_lost,
    frames_lost,
    not_cfs,
    not_examined,
    out_of_order,
    proxy_faults,
    stream_gap,
)
from edoras_tools.diagnosis.rules.commands import bad_command
from edoras_tools.diagnosis.rules.files import (
    file_checksum,
    file_not_finished,
    file_pieces_resent,
    file_stalled,
)
from edoras_tools.diagnosis.rules.flight_software import (
    cfs_errors,
    cfs_restart,
    event_squelch,
    event_suppression,
    not_observable,
)
from edoras_tools.diagnosis.rules.gaps import (
    crossing_loss,
    lost_after_cfs,
    older_losses,
    superseded,
    unattributed_loss,
    unexplained_gap,
)
from edoras_tools.diagnosis.rules.ingest import app_outage, ci_backlog, ci_cut, host_drops, lost_before_ci
from edoras_tools.diagnosis.rules.messages import (
    flight_bridge_length,
    ground_bridge_buffer,
    no_subscriber,
    stale_tail,
    struct_overrun,
)
from edoras_tools.diagnosis.rules.network import (
    sbn_disconnected,
    sbn_never_connected,
    sbn_table,
    sbn_tcp_overwritten,
    sbn_timeout,
)
from edoras_tools.diagnosis.rules.network_messages import (
    bad_network_message,
    proto_storm,
    subscription_storm,
    unknown_peer,
    wrong_ident,
    wrong_protocol_version,
)
from edoras_tools.diagnosis.rules.output import to_destination, to_not_enabled, to_stopped, to_taken_over
from edoras_tools.diagnosis.rules.pipes import (
    app_pipe_limit,
    app_pipe_overflow,
    sbn_peer_pipe,
    to_message_limit,
    to_pipe_overflow,
)
from edoras_tools.diagnosis.rules.routes import (
    not_configured,
    rate_over_limit,
    topic_never_seen,
    wrong_direction,
    wrong_type,
)
from edoras_tools.diagnosis.rules.samples import dds_lost, dds_not_captured, dds_resent
from edoras_tools.diagnosis.rules.security import (
    checksum,
    identity_from_two_addresses,
    privileged_commands,
    repeated_commands,
    stranger_commands,
)
from edoras_tools.diagnosis.rules.silence import telemetry_vanished, topic_silent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

    Rule = Callable[[Case], Iterator[Verdict]]

_OF_FILES = (file_checksum, file_not_finished, file_stalled, file_pieces_resent)
_OF_SAMPLES = (dds_lost, dds_not_captured, dds_resent)
OTHERS: Final[tuple[Rule, ...]] = (
    not_examined,
    not_cfs,
    frames_lost,
    fprime_packets_lost,
    *_OF_FILES,
    *_OF_SAMPLES,
)
"""Those that are not about the rows of a case: a capture may hold nothing else."""
RULES: Final[Mapping[str, Rule]] = {
    rule.__name__: rule
    for rule in (
        not_examined,
        capture_drops,
        host_drops,
        cut_frames,
        stream_gap,
        frames_lost,
        fprime_packets_lost,
        not_cfs,
        captured_twice,
        out_of_order,
        duplicated,
        clock_jump,
        proxy_faults,
        cfs_restart,
        not_observable,
        lost_before_ci,
        ci_backlog,
        app_outage,
        app_pipe_limit,
        app_pipe_overflow,
        to_message_limit,
        to_pipe_overflow,
        sbn_peer_pipe,
        crossing_loss,
        lost_after_cfs,
        unexplained_gap,
        unattributed_loss,
        struct_overrun,
        telemetry_vanished,
        topic_silent,
        ci_cut,
        ground_bridge_buffer,
        flight_bridge_length,
        bad_command,
        no_subscriber,
        rate_over_limit,
        sbn_timeout,
        sbn_tcp_overwritten,
        sbn_never_connected,
        sbn_disconnected,
        bad_network_message,
        wrong_ident,
        wrong_protocol_version,
        unknown_peer,
        sbn_table,
        to_not_enabled,
        to_destination,
        to_stopped,
        wrong_direction,
        wrong_type,
        topic_never_seen,
        not_configured,
        stale_tail,
        older_losses,
        event_suppression,
        event_squelch,
        stranger_commands,
        identity_from_two_addresses,
        repeated_commands,
        privileged_commands,
        to_taken_over,
        checksum,
        subscription_storm,
        proto_storm,
        superseded,
        cfs_errors,
        *_OF_FILES,
        *_OF_SAMPLES,
    )
}
"""By the name that their verdicts carry."""

SINGLE: Final = frozenset(
    {
        "struct_overrun",
        "ci_cut",
        "ground_bridge_buffer",
        "flight_bridge_length",
        "bad_command",
        "no_subscriber",
        "bad_network_message",
        "wrong_ident",
        "wrong_protocol_version",
        "unknown_peer",
        "wrong_type",
        "host_drops",
    }
)
"""Rules about messages that come to nothing by what they are; asked first: the balance has their figures."""
