"""The workers: a cluster of dask.distributed, on this machine or a real one."""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final

import dask
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.core import rpc
from distributed.security import Security

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Iterator

_PATIENCE_S: Final = 10
"""A scheduler that has not answered by then, or has no worker, is refused."""

_THRIFTY: Final = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
}
"""What local workers do beside their work, less often: 1 % of a core instead of 4. And not the 64 KiB that
dask has a worker keep of freed memory: each larger column would be mapped anew, a quarter of all its time."""


@contextmanager
def workers(jobs: int, scheduler: str, *, most: int) -> Iterator[Client]:
    """Yield a client of a cluster that has at least one worker.

    A local cluster speaks TLS with a certificate that only its own processes have: on a machine with several
    users nobody else can give it work.

    Args:
        jobs: worker processes on this machine; 0: one for each processor core.
        scheduler: address of a dask scheduler to use instead; empty for none.
        most: more processes than this on this machine would have nothing to do.

    Raises:
        CaptureError: the scheduler does not answer, or has no worker.
    """
    quiet = logging.CRITICAL + 1  # a lost worker is told by whoever waits for its results
    for name in ("asyncio", "tornado", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in {"asyncio", "distributed", "tornado"}:
            logging.getLogger(name).setLevel(quiet)
    with ExitStack() as opened:
        opened.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{_PATIENCE_S}s"}))
        if scheduler:
            yield opened.enter_context(_client(scheduler))
            return
        opened.enter_context(dask.config.set(_THRIFTY))
        cluster = opened.enter_context(
            LocalCluster(
                n_workers=min(jobs or CPU_COUNT, most),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                security=Security.temporary(),
                silence_logs=quiet,
            )
        )
        yield opened.enter_context(Client(cluster, set_as_default=False))


def _client(scheduler: str) -> Client:
    try:
        kind = asyncio.run(asyncio.wait_for(_kind(scheduler), _PATIENCE_S))
    except (OSError, TimeoutError, asyncio.TimeoutError, ValueError, ImportError) as error:
        raise CaptureError(
            f"{scheduler}: no dask scheduler answers there; start one with 'dask scheduler', or leave "
            "--scheduler out"
        ) from error
    if kind != "Scheduler":
        raise CaptureError(f"{scheduler}: is the address of a {kind}, not of a dask scheduler; name that")
    client = Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except (TimeoutError, asyncio.TimeoutError) as error:
        client.close()
        raise CaptureError(
            f"{scheduler}: the scheduler has no worker; start some with 'dask worker {scheduler}'"
        ) from error
    return client


async def _kind(address: str) -> str:
    """Ask who is at an address: ``Client`` would wait for ever for one that accepts and says nothing."""
    async with rpc(address, connection_args=Security().get_connection_args("client")) as other:
        return str((await other.identity())["type"])
