"""The objects that every pipeline needs: the mission, the types, and the decoders that share them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.mission import Mission
from edoras_tools.ros import TypeStore
from edoras_tools.ros.store import USUAL_DISTRO
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.links.doors import Endpoints, Unwrapper
    from edoras_tools.model import Link, SourceInfo
    from edoras_tools.wire.cfe import Headers

_LAYOUTS: Final = "structs/"
"""Prefix of the names of layouts in a recording, which also contains the mission files."""


class Workbench(msgspec.Struct, frozen=True, eq=False, dict=True):
    """A mission, its types, and one decoder of each kind over the same context.

    Attributes:
        mission: the routes and links.
        types: the ROS types.
        columns: decodes batches.
        unwrappers: objects that take packets out of the frames that carry them, by link.
    """

    mission: Mission
    types: TypeStore
    columns: ColumnDecoder
    unwrappers: Mapping[Link, Unwrapper] = msgspec.field(default_factory=dict)

    @cached_property
    def dissector(self) -> Dissector:
        """Decodes single packets, with every field's bytes."""
        from edoras_tools.decode import Dissector

        return Dissector(self.columns.context)

    def with_headers(self, headers: Headers) -> Workbench:
        """Return a workbench for packets with the headers and MsgIds of another build."""
        old = self.columns.context
        mission, options = self.mission.numbered(headers.msg_ids), old.options.with_headers(headers)
        structs = old.structs if headers.msg_ids is old.msg_ids else None
        return _bench(Context(mission, self.types, options, structs))

    def fresh(self, paths: Sequence[Path] = ()) -> Workbench:
        """Return an equal workbench for another source: no file is read again, and no decoder state is kept.

        Args:
            paths: files of the source, see ``Settings.workbench``.
        """
        return _enable_look_ahead(self.with_mission(self.mission), paths)

    def with_mission(self, mission: Mission) -> Workbench:
        """Return a workbench with another mission, for another source."""
        old = self.columns.context
        return _bench(Context(mission, self.types, old.options, old.structs))


class Settings(msgspec.Struct, frozen=True):
    """The command line's settings for missions, types and decoding.

    Attributes:
        configs: mission files.
        distro: ROS distribution whose message definitions are used.
        msg_paths: folders with more ``.msg`` and ``.idl`` files.
        options: decoding options.
        structs: layouts of C structs; they take precedence over cFE's own.
        constants: constants of cFS by name; they take precedence over those of mission files.
        ros_args: words after ``--ros-args``, which apply to all mission files.
    """

    configs: Sequence[Path] = ()
    distro: str = USUAL_DISTRO
    msg_paths: Sequence[Path] = ()
    options: Options = Options()
    structs: Sequence[Path] = ()
    constants: Mapping[str, Any] = msgspec.field(default_factory=dict)
    ros_args: Sequence[str] = ()

    def workbench(self, info: SourceInfo | None = None, paths: Sequence[Path] = ()) -> Workbench:
        """Load the mission, the types and the layouts, and make the decoders.

        Args:
            info: info of the source; see ``context``.
            paths: files of the source; announced topics are looked up in these first.

        Raises:
            ConfigError: a mission, a type folder or an option has errors.
        """
        return _enable_look_ahead(_bench(self.context(info)), paths)

    def context(self, info: SourceInfo | None = None) -> Context:
        """Load the mission, the types and the layouts.

        Args:
            info: info of the source. A recording's mission files and struct layouts are used if none are
                named, its decoding options if none are given, its message definitions before the
                distribution's.

        Raises:
            ConfigError: a mission, a type folder or an option has errors.
        """
        attached = info.attachments if info else {}
        options = self.options.over(info.read_with) if info else self.options
        types = TypeStore(self.distro, self.msg_paths, info.definitions if info else None)
        bridges = {name: data for name, data in attached.items() if not name.startswith(_LAYOUTS)}
        mission = Mission(msg_ids=options.msg_ids)
        if self.configs or bridges:
            from edoras_tools.mission import load, loads

            read = partial(loads, bridges, check_type=types.check)
            if self.configs:
                read = partial(load, self.configs, check_type=types.check, ros_args=self.ros_args)
            mission = read(msg_ids=options.msg_ids)
        if headers := mission.software.headers:
            options = options.saying(headers)
            if options.msg_ids is not mission.msg_ids:
                mission = read(msg_ids=options.msg_ids)
        if self.constants:
            mission = replace(mission, software=mission.software.stating(self.constants))
        msg_ids = options.msg_ids
        carried = {name: data for name, data in attached.items() if name.startswith(_LAYOUTS)}
        structs = shipped_structs(msg_ids, big_endian=mission.software.big_endian)
        if self.structs or carried:
            from edoras_tools.structs.files import parse_layout as loads_layout
            from edoras_tools.structs.files import read_layout

            layout_files = [read_layout(path) for path in self.structs]
            contents = [(str(file), data) for file, data in layout_files] or list(carried.items())
            layouts = [loads_layout(data, name) for name, data in contents]
            structs = Structs([*layouts, *structs.layouts], msg_ids, big_endian=structs.big_endian)
            names = [f"{_LAYOUTS}{place}_{file.name}" for place, (file, _) in enumerate(layout_files, 1)]
            files = dict(zip(names or carried, (data for _, data in contents), strict=True))
            mission = replace(mission, files={**mission.files, **files})
        return Context(mission, types, options, structs)


def _bench(context: Context) -> Workbench:
    from edoras_tools.decode import ColumnDecoder

    pairs: Iterable[tuple[Link, Unwrapper | None]] = (
        (link, link.unwrapper(context)) for link in context.links
    )
    unwrappers = {link: item for link, item in pairs if item is not None}
    assert context.types is not None, "settings always have types"
    return Workbench(context.mission, context.types, ColumnDecoder(context), unwrappers)


def _enable_look_ahead(bench: Workbench, paths: Sequence[Path]) -> Workbench:
    """Let decoders look ahead in the files, if these can be read twice."""
    if paths and all(path.is_file() or path.is_dir() for path in paths):
        context = bench.columns.context
        context.look_ahead = partial(_announced_in, paths)
        context.spacecraft.survey = partial(_spacecraft_in, paths, bench)
    return bench


def _spacecraft_in(paths: Sequence[Path], bench: Workbench) -> dict[int, int]:
    """Return the number of the spacecraft of each address of cFS in captures, as far as they can be read."""
    from edoras_tools.decode.spacecraft import Survey

    survey, own = Survey(bench.columns.context.spacecraft), bench.fresh()
    own.columns.settle()
    own.columns.context.spacecraft.settled = True
    with suppress(CaptureError), closing(open_files(paths)) as source:
        source.follow(own.columns.context.framings)
        batches = source.batches()
        for unwrapper in own.unwrappers.values():
            batches = map(unwrapper.take, batches)
        for batch in batches:
            if len(batch):
                opening = own.columns.begin(batch)
                assert opening.part is not None, "begun here"
                survey.add(opening.part, opening.out, opening.start, own.columns.context.msg_ids)
    return survey.numbers()


def _announced_in(paths: Sequence[Path]) -> Endpoints:
    """Return the announcements of DDS participants in captures, as far as they can be read."""
    from edoras_tools.decode import ColumnDecoder

    decoder = ColumnDecoder(Context())
    with suppress(CaptureError), closing(open_files(paths)) as source:
        for batch in source.batches():
            decoder.learn(batch)
    return decoder.context.endpoints


def open_files(paths: Sequence[Path]) -> Source:
    """Open captures and recordings as one source, in time order.

    Raises:
        CaptureError: one cannot be opened.
    """
    from edoras_tools.io.formats.open import open_file

    if len(paths) == 1:
        return open_file(paths[0])
    from edoras_tools.io.formats.merge import merge_sources

    with ExitStack() as opened:
        sources = [opened.enter_context(closing(open_file(path))) for path in paths]
        opened.pop_all()
    return merge_sources(sources)


def read_constants(constants: Sequence[str]) -> dict[str, Any]:
    """Return constants by name.

    Args:
        constants: ``NAME=VALUE`` each, whole numbers; ``to_limits=FILE`` and ``sbn_table=FILE``: images of
            the tables of Telemetry Output and of SBN.

    Raises:
        ConfigError: there is no such constant, or it cannot have that value.
        CaptureError: the table image cannot be read.
    """
    from edoras_tools.cfs.profile import SimProfile, constant_names
    from edoras_tools.io.formats.cfe import message_limits, network_peers

    tables = {"to_limits": message_limits, "sbn_table": network_peers}
    names, changes = constant_names(), dict[str, Any]()
    for text in constants:
        name, _, value = text.partition("=")
        if name in tables:
            changes[name] = tables[name](Path(value))
            continue
        if name not in names:
            hint = did_you_mean(name, sorted({*names, *tables}), 1)
            hint = hint or f"there are {', '.join(sorted(names))}"
            raise ConfigError(f"constant {name!r} is not known; {hint}")
        try:
            changes[name] = int(value, 0)
        except ValueError:
            raise ConfigError(f"constant {text!r}: {value!r} is not a whole number; write {name}=8") from None
    SimProfile().stating(changes)
    return changes
