"""Yamcs, started with an instance of a test's own, and its HTTP API."""

from __future__ import annotations

import json
import urllib.request
from contextlib import contextmanager

from places import ROOT
from waiting import HOST, PATIENCE_S, Program

YAMCS = ROOT / ".yamcs"
ABSENT = YAMCS / "absent"
WHY = ABSENT.read_text().strip() if ABSENT.exists() else "Yamcs is not installed: make yamcs"
HERE = (YAMCS / ".installed").exists()
_SERVER = """
services: [{{class: org.yamcs.http.HttpServer, args: {{port: {http}, address: 127.0.0.1}}}}]
instances: [edoras]
dataDir: {folder}/data
"""
_PROCESSOR = """
realtime:
  services:
    - {class: org.yamcs.StreamTmPacketProvider}
    - {class: org.yamcs.StreamTcCommandReleaser}
  config: {subscribeAll: true, persistParameters: false}
"""


@contextmanager
def yamcs(folder, http, instance):
    """Run Yamcs in a folder until the block ends; ``instance`` is the text of ``yamcs.edoras.yaml``."""
    (folder / "etc").mkdir()
    (jars,) = YAMCS.glob("lib/python*/site-packages/fprime_yamcs_bundle/lib")
    (folder / "etc/yamcs.yaml").write_text(_SERVER.format(http=http, folder=folder))
    (folder / "etc/yamcs.edoras.yaml").write_text(instance)
    (folder / "etc/processor.yaml").write_text(_PROCESSOR)
    words = ("-cp", f"{jars}/*", "org.yamcs.YamcsServer", "--etc-dir", folder / "etc")
    with Program(YAMCS / "bin/java", *words, cwd=folder) as server:
        server.until(lambda: any("Yamcs started" in line for line in server.err.lines + server.out.lines))
        yield server


def asked(address, body=None):
    """Return what its API answers."""
    data = None if body is None else json.dumps(body).encode()
    with urllib.request.urlopen(urllib.request.Request(address, data), timeout=PATIENCE_S) as answer:
        return json.load(answer)


def api(http):
    """Return the address of its API."""
    return f"http://{HOST}:{http}/api"
