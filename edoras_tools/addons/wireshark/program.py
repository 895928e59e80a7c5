"""The installed Wireshark and tshark: path, version, whether they have Lua, and their folders.

Also the Lua dissector for a mission: the knowledge that the layouts do not contain, as plain values.

Without a mission this dissector knows the four demos of the EDORAS paper. If two of them use the same MsgId,
the first whose message type fits the bytes is used. Structs of own layouts and of cFE's housekeeping become
tables, from which the dissector adds headers.
"""

from __future__ import annotations

import ipaddress
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.decode import Context
from edoras_tools.dissectors.lua import GUARD, TITLE, FindingText, Knowledge, RouteText, generate, own_digest
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.outputs import write_files
from edoras_tools.mission import Mission, load, loads
from edoras_tools.model import NO_ROUTE, UNKNOWABLE, Finding, PacketBatch
from edoras_tools.pipelines.reading import on_interrupt
from edoras_tools.render.severity import EXPLANATIONS, Level
from edoras_tools.ros import TypeStore
from edoras_tools.ros.cdr.plan import CdrPlan, PrimitiveRun, Repeat, Text
from edoras_tools.ros.library import PLACEHOLDER, full_name
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.structs.files import load_layout
from edoras_tools.structs.shapes import BasicKind
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.structs.bindings import Bound
    from edoras_tools.structs.messages import StructLeaf

DEMOS: Final = (
    ("rover_ground",),
    ("single_arm_ground",),
    ("two_rovers_ground", "two_rovers_flight"),
    ("two_arms_ground", "two_arms_flight"),
)


def dissector(settings: Settings) -> tuple[str, list[str]]:
    """Return the Lua dissector for the missions, or for the demos if there is none; and warnings.

    Raises:
        ConfigError: a mission file, a type folder or an option has errors. An unknown type is only a warning:
            the rest of its packets is still dissected.
    """
    types = TypeStore(settings.distro, settings.msg_paths)
    if settings.configs:
        missions = [load(settings.configs, msg_ids=settings.options.msg_ids)]
        note = f"Routes of {', '.join(missions[0].files)}; ROS 2 {settings.distro}."
    else:
        missions = [_demo(names) for names in DEMOS]
        note = f"Routes of the demos of the EDORAS paper; ROS 2 {settings.distro}."
    warnings = [text for mission in missions for text in mission.warnings]
    for name in dict.fromkeys(route.type for mission in missions for route in mission.routes):
        why = types.check(name)
        if why is not None:
            warnings.append(f"{name} is left as bytes: {why}")
    layouts = [load_layout(path) for path in settings.structs]
    msg_ids, software = settings.options.msg_ids, missions[0].software
    shipped = shipped_structs(msg_ids, big_endian=software.big_endian)
    structs = Structs([*layouts, *shipped.layouts], msg_ids) if layouts else None
    contexts = [
        Context(mission, types, settings.options.saying(mission.software.headers), structs)
        for mission in missions
    ]
    return generate(replace(_knowledge(contexts, types), note=note)), warnings


def _demo(names: Sequence[str]) -> Mission:
    folder = files("edoras_tools.samples") / "missions"
    return loads({f"{name}.yaml": (folder / f"{name}.yaml").read_bytes() for name in names})


def _ports(masks: Iterable[NDArray[np.bool_]]) -> list[int]:
    return sorted({int(port) for mask in masks for port in np.flatnonzero(mask)})


def _knowledge(contexts: Sequence[Context], types: TypeStore) -> Knowledge:
    """Collect the knowledge of several missions; routes are numbered in their order."""
    routes: list[RouteText] = []
    exact: dict[str, dict[int, list[int]]] = {link.label: {} for link in contexts[0].links}
    any_link: dict[int, list[int]] = {}
    for context in contexts:
        first = len(routes)
        routes += [
            RouteText(route.topic, full_name(route.type), context.envelopes[index])
            for index, route in enumerate(context.mission.routes)
        ]
        for link in contexts[0].links:
            _claim(exact[link.label], context.routes_on(link), first)
        _claim(any_link, context.any_route_of, first)
    headers, table = contexts[0].headers, contexts[0].structs.dictionary
    return Knowledge(
        findings=[_finding(item) for item in Finding],
        links=contexts[0].links,
        ports={link.label: _ports(item.ports[link] for item in contexts) for link in contexts[0].links},
        stream_ports={
            link.label: _ports(item.stream_links == link for item in contexts) for link in contexts[0].links
        },
        bridge_ports=_ports(item.bridge_ports for item in contexts),
        cfs_addresses=sorted(
            {str(ipaddress.IPv4Address(address)) for item in contexts for address in item.cfs_addresses}
        ),
        identities=sorted({identity for item in contexts for identity in item.identities}),
        routes=routes,
        exact={link: claims for link, claims in exact.items() if claims},
        any_link=any_link,
        types={
            name: _type(types, name)
            for name in dict.fromkeys(route.type for route in routes)
            if types.has(name)
        },
        extended_header=headers.extended,
        telemetry_header=headers.telemetry_bytes,
        msg_id_version=headers.msg_ids.version,
        time=contexts[0].time,
        pdu_msg_ids=sorted({int(item) for context in contexts for item in context.pdu_msg_ids}),
        frames={
            item.port: (item.format, item.link.label)
            for context in contexts
            for item in context.mission.frames
        },
        dictionary=table.engine_values() if table else {},
        structs=engine_structs(contexts[0].structs),
    )


def _claim(claims: dict[int, list[int]], route_of: Iterable[int], first: int) -> None:
    table = np.asarray(route_of)
    for msg_id in np.flatnonzero(table != NO_ROUTE).tolist():
        claims.setdefault(msg_id, []).append(first + int(table[msg_id]))


def _finding(item: Finding) -> FindingText:
    explanation = EXPLANATIONS[item]
    return FindingText(
        bit=int(item),
        label=item.label,
        severity=explanation.severity.label,
        short=explanation.short if explanation.severity > Level.NOTE else "",
        meaning=explanation.meaning,
        unknowable=item in UNKNOWABLE,
    )


def _type(types: TypeStore, name: str) -> Mapping[str, Any]:
    _, plan = types.plan(name)
    return {"fixed": plan.fixed_size, "trailing": plan.most_trailing, "steps": _steps(plan)}


def _steps(plan: CdrPlan) -> list[dict[str, Any]]:
    return [_step(step) for step in plan.steps]


def _step(step: PrimitiveRun | Text | Repeat) -> dict[str, Any]:
    if isinstance(step, PrimitiveRun):
        return {
            "alignment": step.alignment,
            "size": step.size,
            "leaves": [
                {name: getattr(leaf, name) for name in ("name", "code", "size", "count", "offset")}
                | {"hidden": leaf.name.endswith(PLACEHOLDER) or None}
                for leaf in step.leaves
            ],
        }
    if isinstance(step, Text):
        return {"name": step.name, "bound": step.bound, "width": step.width}
    uniform, first = step.plan.uniform, step.plan.steps[0]
    label = first.leaves[0].name if isinstance(first, PrimitiveRun) else first.name
    return {
        "name": step.name,
        "count": step.count,
        "bound": step.bound,
        "least": step.plan.least,
        "element": step.plan.element is not None or None,
        "uniform": {"alignment": uniform.alignment, "size": uniform.size} if uniform else None,
        "unnamed": not label or None,
        "steps": _steps(step.plan),
    }


_MOST: Final = 512
"""Most values of a struct that are shown."""
_IN_THE_ENGINE: Final = tuple(cfe.PAYLOADS)
_WHOLE: Final = {BasicKind.UINT: "uint", BasicKind.BOOL: "uint", BasicKind.CHAR: "uint", BasicKind.INT: "int"}


def engine_structs(structs: Structs) -> dict[str, Any]:
    """Return the structs that a layout names, and those of cFE's telemetry, for ``engine/packet.lua``.

    Commands, events and the software bus's counters have tables in the engine, unless a layout names them.

    Returns:
        ``layouts``: a table for each struct in a packet, by name; ``packets``: by MsgId the ``name`` of the
        packets, if all have the same and it is not one of cFE's, and the name of the table by function code
        (-1: all codes).
    """
    layouts: dict[str, Any] = {}
    packets: dict[int, dict[Any, Any]] = {}
    for bound in structs.all:
        code, standard = bound.key.function_code, structs.msg_ids.standard(bound.key.msg_id)
        if bound.shipped and (code is not None or standard in _IN_THE_ENGINE):
            continue
        if bound.key.port is not None or bound.layout.entries:
            continue
        name = f"struct {bound.key}"
        layouts[name] = _layout(bound)
        title = "" if bound.shipped else structs.name(bound.key.msg_id)
        packet = packets.setdefault(bound.key.msg_id, {"name": title or None})
        packet[-1 if code is None else code] = name
    return {"layouts": layouts, "packets": packets}


def _layout(bound: Bound) -> dict[str, Any]:
    least, most, step = bound.extent
    leaves = bound.plan(least).leaves
    fields = [*islice((item for leaf in leaves for item in _fields(bound, leaf)), _MOST)]
    return {
        "name": bound.name,
        "protocol": "cfe",
        "title": bound.name,
        "size": least,
        "most": most,
        "step": step or None,
        "own": not bound.shipped or None,
        "little": bound.layout.byte_order == "little" or None,
        "fields": fields,
    }


def _fields(bound: Bound, leaf: StructLeaf) -> Iterator[dict[str, Any]]:
    """Yield the fields of a value, or of each element of an array; elements share the field of their name."""
    member = leaf.member
    basic, size = bound.layout.basic(member), leaf.end - leaf.start
    if basic is None or not size:
        return
    step = bound.layout.size(member) if member.array else size
    name = ".".join(part for part in leaf.path if isinstance(part, str))
    kind, mask, values = "bytes", None, bound.values(member)
    if member.text:
        kind = "string"
    elif basic.kind is BasicKind.FLOAT:
        kind = "double" if step == 8 else "float"
    elif basic.kind in _WHOLE and step in {1, 2, 4, 8}:
        kind = f"{_WHOLE[basic.kind]}{8 * step}"
        if member.bits:
            shift = member.bit if bound.layout.is_little(member) else 8 * step - member.bit - member.bits
            mask = ((1 << member.bits) - 1) << shift
        if basic.kind is BasicKind.BOOL:
            values = {0: "false", 1: "true"}
    else:
        step = size
    unit = f"in {member.unit}" if member.unit else ""
    sent = "the number as it is sent, not calibrated" if member.polynomial else unit
    for start in range(leaf.start, leaf.end, step):
        yield {
            "abbreviation": f"cfs.{bound.name}.{name}",
            "name": name,
            "start": start,
            "size": step,
            "kind": kind,
            "turned": (bool(member.order) and member.order != bound.layout.byte_order) or None,
            "mask": mask,
            "hex": (member.base == 16 and "int" in kind) or None,
            "names": dict(values) if "int" in kind and values else None,
            "doc": ", ".join(filter(None, (member.doc, sent))),
        }


SCRIPT: Final = "edoras.lua"
LAUNCHER: Final = "edoras-extcap"
PROFILE: Final = "EDORAS"
_BY_WIRESHARK: Final = "recent"
"""File of a profile that Wireshark rewrites each time it ends."""
_NAMES: Final = {
    "plugins": ("Personal Lua Plugins", "Personal Plugins"),
    "extcap programs": ("Personal Extcap path", "Extcap path"),
    "profiles": ("Personal configuration",),
}
"""Wireshark's names for its folders, by their content."""
_PROFILE_FILES: Final = files("edoras_tools.addons.wireshark") / "profile"
_MODULE: Final = "edoras_tools.addons.wireshark.cli.extcap"
OLDEST: Final = (3, 6)
"""The oldest Wireshark with all Lua functions that the dissector uses."""
_READS: Final = frozenset({"pcap", "pcapng"})
_COMPRESSED: Final = ".zst"
"""Suffix of compressed files, which not every Wireshark can read."""
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY")
_THEN_REMOVE: Final = '"$@"; code=$?; rm -rf "$0"; exit $code'
"""Shell script that deletes the files after Wireshark has ended, which may be after this process."""


def find_program(*names: str) -> str:
    """Return the path of the first installed one of some programs; it must have Lua.

    Raises:
        CaptureError: none is installed, or it is too old or without Lua.
    """
    program = next((path for path in map(shutil.which, names) if path), None)
    if program is None:
        raise CaptureError(
            f"{' or '.join(names)} is not installed; on Debian and Ubuntu: apt install {names[0]}"
        )
    _check(program, Path(program).stat().st_mtime_ns)
    return program


@cache
def _check(program: str, _changed_ns: int) -> None:
    """Check a program once; it runs for half a second to print its version."""
    output = _ask(program, "--version")
    version = re.search(r"(\d+)\.(\d+)\.\d+", output)
    if version is None:
        raise CaptureError(f"{program}: does not print its version; is it from Wireshark?")
    described = f"{program}: version {version[0]}"
    if (int(version[1]), int(version[2])) < OLDEST:
        raise CaptureError(f"{described} is too old; {OLDEST[0]}.{OLDEST[1]} or newer is needed")
    if not re.search(r"with\s+Lua", output):
        raise CaptureError(f"{described} was built without Lua; install a build that has it")


def folders() -> dict[str, Path]:
    """Return Wireshark's folders by its own names, e.g. ``Personal Lua Plugins``.

    Raises:
        CaptureError: Wireshark is not installed, too old, or without Lua.
    """
    lines = _ask(find_program("tshark", "wireshark"), "-G", "folders").splitlines()
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): Path(path.strip()) for name, colon, path in pairs if colon and path.strip()}


def _own(by_name: Mapping[str, Path], noun: str) -> Path:
    """Return the first of Wireshark's folders for a kind of content; see ``_NAMES``."""
    for name in _NAMES[noun]:
        if name in by_name:
            return by_name[name]
    raise CaptureError(f"this Wireshark has no folder for {noun}; name one with --to")


def install(text: str, folder: Path | None = None, *, force: bool = False) -> Path:
    """Write the dissector to the folder from which Wireshark and tshark load it; return its path.

    Args:
        folder: folder to write to instead of the personal plugin folder.
        force: replace another dissector that is there.

    Raises:
        CaptureError: Wireshark is not installed, or the file cannot be written.
        ConfigError: another one is there.
    """
    folder = folder or _own(folders(), "plugins")
    return _write(folder / SCRIPT, text, force=force)


def install_profile() -> tuple[Path, bool]:
    """Write the profile ``EDORAS``: columns, colours, filter buttons and graphs; an existing one stays.

    Returns:
        its folder, and whether its content is ours.

    Raises:
        CaptureError: Wireshark is not installed, or a file cannot be written.
    """
    folder = _own(folders(), "profiles") / "profiles" / PROFILE
    if not folder.exists():
        written = {folder / item.name: item.read_bytes() for item in _PROFILE_FILES.iterdir()}
        write_files(written, force=False)
    return folder, _is_ours(folder)


def uninstall() -> Iterator[tuple[Path, bool]]:
    """Remove the dissector, the profile and the capture interfaces from Wireshark's personal folders.

    Yields:
        each path that exists, and whether it was removed: files and profiles that were changed are kept.

    Raises:
        CaptureError: Wireshark is not installed, or a file cannot be removed.
    """
    by_name = folders()
    script, launcher = _own(by_name, "plugins") / SCRIPT, _own(by_name, "extcap programs") / LAUNCHER
    folder = _own(by_name, "profiles") / "profiles" / PROFILE
    try:
        for path, mark in ((script, TITLE), (launcher, _MODULE)):
            if path.exists():
                if own := mark in path.read_text(encoding="utf-8", errors="replace"):
                    path.unlink()
                yield path, own
        if folder.exists():
            if own := _is_ours(folder):
                shutil.rmtree(folder)
            yield folder, own
    except OSError as error:
        raise CaptureError(f"{error.filename}: cannot be removed: {error.strerror}") from error


def _is_ours(folder: Path) -> bool:
    """Return whether a profile is unchanged, apart from the file that Wireshark itself rewrites."""
    ours, theirs = (
        {item.name: item.read_bytes() for item in place.iterdir() if item.is_file()}
        for place in (_PROFILE_FILES, folder)
    )
    return ours | {_BY_WIRESHARK: b""} == theirs | {_BY_WIRESHARK: b""}


def install_extcap(folder: Path | None = None, *, force: bool = False) -> Path:
    """Write the launcher of the capture interfaces to Wireshark's extcap folder; return its path.

    Args:
        folder: folder to write to instead of Wireshark's own.
        force: replace another launcher that is there.

    Raises:
        CaptureError: Wireshark is not installed, or the file cannot be written.
        ConfigError: another one is there.
    """
    folder = folder or _own(folders(), "extcap programs")
    text = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m {_MODULE} "$@"\n'
    try:
        path = _write(folder / LAUNCHER, text, force=force)
        path.chmod(0o755)
    except CaptureError as error:
        raise CaptureError(f"{error}; be root, or use --to DIR and WIRESHARK_EXTCAP_DIR=DIR") from error
    return path


def run_program(text: str, file: Path | None, arguments: Sequence[str], *, graphical: bool = False) -> int:
    """Run tshark or Wireshark with this dissector, even if another one is installed; return its exit code.

    Args:
        file: a capture or recording to read; None: the arguments name the input.
        graphical: run Wireshark, not tshark.

    Raises:
        CaptureError: the program is not installed, or the file cannot be read.
    """
    path = find_program("wireshark" if graphical else "tshark")
    with tempfile.TemporaryDirectory(prefix="edoras-") as name:
        folder = Path(name)
        script = _write(folder / SCRIPT, text, force=False)
        command = [path, "-X", f"lua_script:{script}"]
        with _readable(file, folder) as capture:
            command += ["-r", str(capture)] if capture else []
            environment = os.environ | {GUARD: own_digest(text)}
            # Ctrl-C also reaches the program, which handles it itself.
            with on_interrupt(lambda: None):
                return subprocess.run([*command, *arguments], env=environment, check=False).returncode  # noqa: S603


def open_packets(batches: Iterable[PacketBatch], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Write packets to a file and open Wireshark with the dissector on it.

    Args:
        row: the packet to go to, from 0.

    Returns:
        The process, which removes the file when Wireshark ends.

    Raises:
        EdorasError: Wireshark is not installed, there is no display, or the file cannot be written.
    """
    path = find_program("wireshark")
    if sys.platform not in {"darwin", "win32"} and not any(map(os.environ.get, _DISPLAYS)):
        raise CaptureError("Wireshark needs a display: set DISPLAY or WAYLAND_DISPLAY")
    text, _ = dissector(settings)
    folder = Path(tempfile.mkdtemp(prefix="edoras-"))
    try:
        script, capture = _write(folder / SCRIPT, text, force=False), folder / "packets.pcapng"
        _write_packets(batches, capture)
        arguments = ["-X", f"lua_script:{script}", "-r", str(capture), "-g", str(row + 1)]
        return subprocess.Popen(  # noqa: S603  the user asked for it
            ["/bin/sh", "-c", _THEN_REMOVE, str(folder), path, *arguments],
            env=os.environ | {GUARD: own_digest(text)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, CaptureError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise CaptureError(f"Wireshark cannot be opened: {error}") from error


@contextmanager
def _readable(file: Path | None, folder: Path) -> Iterator[Path | None]:
    """Yield a file that Wireshark can read: a recording is first written as pcapng."""
    if file is None or str(file) == "-":
        yield file
        return

    with closing(open_file(file)) as source:
        if source.info.kind in _READS and file.suffix != _COMPRESSED:
            yield file
            return
        target = folder / f"{file.stem}.pcapng"
        _write_packets(source.batches(), target)
    yield target


def _write_packets(batches: Iterable[PacketBatch], path: Path) -> None:
    with closing(PcapngSink(path)) as sink:
        for batch in batches:
            sink.write(batch)


def _ask(path: str, *arguments: str) -> str:
    try:
        return subprocess.run(  # noqa: S603  a program of the user's own path
            [path, *arguments], capture_output=True, check=False, text=True, errors="replace", timeout=60
        ).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CaptureError(f"{path}: cannot be run: {error}") from error


def _write(path: Path, text: str, *, force: bool) -> Path:
    write_files({path: text.encode()}, force=force)
    return path
