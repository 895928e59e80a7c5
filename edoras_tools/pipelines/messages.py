"""Opens captures and recordings; those without datagrams become a source of messages.

The topics of such recordings are the routes of a mission made for them (``Mission.recorded``). So all code
that reads a capture by its routes reads them, too. They have no link and no MsgId.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.decode.stack import JSON_ENCODING
from edoras_tools.errors import ConfigError, NoDatagramsError, OnFailure
from edoras_tools.io.formats.merge import merge_sources
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.rosbag2.reader import MessageSource, NumberedTopics
from edoras_tools.io.topics.streams import QOS_METADATA
from edoras_tools.mission import Handling, Mission, RecordedTopic, Route
from edoras_tools.model import NO_MSG_ID, OTHER
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import text_of_idl
from edoras_tools.structs import Structs

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io import Source

_LATCHED: Final = re.compile(r"durability: *(1|transient_local)\b")
"""The policy by number or by name, as rosbag2 writes it."""


def open_inputs(paths: Sequence[Path], settings: Settings) -> tuple[Source, Workbench]:
    """Open captures and recordings as one source, and set up the decoders for it.

    Recordings of other tools, without datagrams, become one source of messages.

    Raises:
        CaptureError: one cannot be opened.
        ConfigError: the mission has mistakes, or some hold datagrams and others only topics.
    """
    try:
        source = open_files(paths)
    except NoDatagramsError as error:
        return open_messages(paths, settings, error)
    with OnFailure(source.close):
        return source, settings.workbench(source.info, paths)


def open_messages(
    paths: Sequence[Path], settings: Settings, refusal: NoDatagramsError
) -> tuple[Source, Workbench]:
    """Open recordings without datagrams as one source of messages, and set up the decoders for it.

    Args:
        settings: sources of the definitions that the recordings do not contain.
        refusal: error of ``open_files`` for one of them, which is not opened again: it may be a pipe.

    Raises:
        CaptureError: one cannot be opened.
        ConfigError: others hold datagrams.
    """
    table = NumberedTopics()
    opened: dict[str, Sequence[Any]] = {refusal.path: refusal.files}
    with ExitStack() as stack:
        sources = []
        for path in paths:
            files = opened.pop(str(path), None) or _topic_files(path, refusal.path)
            for file in files:
                stack.callback(file.close)
            sources.append(MessageSource(str(path), files, table))
        bench = message_bench(table.topics, settings)
        stack.pop_all()
    return merge_sources(sources), bench


def _topic_files(path: Path, other: str) -> Sequence[Any]:
    """Return the files of a recording without datagrams.

    Raises:
        ConfigError: this recording has datagrams, and ``other`` has none.
    """
    try:
        open_file(path).close()
    except NoDatagramsError as error:
        return error.files
    raise ConfigError(
        f"{other} contains topics and {path} datagrams; read them separately, draw them with edoras plot, or "
        "compare them with edoras doctor CAPTURE --bag RECORDING"
    )


def message_bench(topics: Sequence[RecordedTopic], settings: Settings) -> Workbench:
    """Return the workbench that reads the messages of some topics.

    Args:
        topics: recorded topics, in order of their number.
        settings: sources of the definitions that the recordings do not contain.

    Raises:
        ConfigError: a folder of types has mistakes.
    """
    texts: dict[str, str] = {}
    unread = []
    for topic in topics:
        try:
            text = definition_of(topic)
            other = texts.setdefault(topic.type, text) if text else ""
            same = text == other or _normal(topic.type, text) == _normal(topic.type, other)
            unread.append(
                "" if same else "its definition differs from that of the same type in another recording"
            )
        except ConfigError as error:
            unread.append(str(error))
    types = TypeStore(settings.distro, settings.msg_paths, texts)
    recorded = tuple(
        replace(topic, unread=why or _unread(topic, types)) for topic, why in zip(topics, unread, strict=True)
    )
    routes = tuple(
        Route(
            f"/{topic.topic.removeprefix('/')}",
            topic.type,
            NO_MSG_ID,
            OTHER,
            "telemetry",
            handling=Handling(transient_local=bool(_LATCHED.search(topic.metadata.get(QOS_METADATA, "")))),
        )
        for topic in topics
    )
    mission = Mission(routes=routes, recorded=recorded)
    return Workbench(mission, types, ColumnDecoder(Context(mission, types, settings.options, Structs())))


def definition_of(topic: RecordedTopic) -> str:
    """Return the ``ros2msg`` text of a topic's type; empty if the recording has no readable one.

    Raises:
        ConfigError: its schema cannot be read.
    """
    if topic.schema_encoding not in {"ros2msg", "ros2idl"} or topic.encoding != "cdr" or not topic.schema:
        return ""
    try:
        text = topic.schema.decode()
    except UnicodeDecodeError as error:
        raise ConfigError("its schema is not text") from error
    return text if topic.schema_encoding == "ros2msg" else text_of_idl(topic.type, text)


def _normal(kind: str, text: str) -> str:
    """Return a definition without comments; unchanged if it has mistakes."""
    types = TypeStore(definitions={kind: text})
    return types.definition(kind) if types.has(kind) else text


def _unread(topic: RecordedTopic, types: TypeStore) -> str:
    """Return the reason why the fields of a topic's messages cannot be read; empty if they can."""
    if topic.encoding == JSON_ENCODING:
        return "json, not cdr: shown and copied, without fields to select, plot or export"
    if topic.encoding != "cdr":
        return f"{topic.encoding or 'of no encoding'}, not cdr: only counted and copied"
    return "without a schema: only counted and copied" if not topic.type else types.check(topic.type) or ""
