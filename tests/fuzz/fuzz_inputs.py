"""More of what is fuzzed: what people and other tools write, filters, definitions, layouts, bags."""

from __future__ import annotations

import json
import tempfile
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.addons.debug_info.dwarf import DebugInfo
from edoras_tools.addons.debug_info.writing import take
from edoras_tools.addons.report.page import page
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.decode.filters.filter import Where
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, FieldError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.rosbag2.reader import open_rosbag
from edoras_tools.mission import load
from edoras_tools.pipelines.faults import load_scenario
from edoras_tools.render.pages import Origin
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import parse_definition
from edoras_tools.structs.files import dumps, parse_layout

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

ROOT = Path(__file__).parents[2]
MISSION = load(ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight"))
TYPES = TypeStore()
BAG = (
    b"rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
    b"  relative_file_paths:\n    - bag_0.db3\n"
)
SPLIT = b"\0\0split\0\0"
"""Between the two files of a bag."""


def _told(error: EdorasError, *names: object) -> str:
    """See to it that an error is lines; return its words without names and numbers."""
    text = str(error)
    assert text, "nothing is said"
    assert text.splitlines() == text.split("\n"), f"not lines: {text!r}"
    for name in names:
        text = text.replace(str(name), "")
    words = text.split("\n", 1)[0].rpartition(": ")[2][:30]
    return "".join(letter for letter in words if not letter.isdigit())


def definition(data: bytes) -> Hashable:
    """A ``.msg`` text: a definition, or all of its mistakes; a store takes what is one."""
    text = data.decode("utf-8", "replace")
    try:
        made = parse_definition("fuzz_msgs/msg/Made", text, "Made.msg")
    except ConfigError as error:
        return _told(error)[:8]  # the words of the text itself are no other behaviour
    try:
        store = TypeStore(definitions={"fuzz_msgs/msg/Made": text})
        wrong = store.check("fuzz_msgs/msg/Made")
        if wrong is None:
            cdr = store.encode("fuzz_msgs/msg/Made", {})
            again = store.encode("fuzz_msgs/msg/Made", store.decode("fuzz_msgs/msg/Made", cdr))
            assert again == cdr, "the defaults, written and read again, differ"
    except (ConfigError, FieldError) as error:  # a default may be one that its field cannot hold
        return _told(error)
    kinds = {(field.type[:4], field.shape, field.default is None) for field in made.fields[:2]}
    return min(len(made.fields), 4), min(len(made.constants), 2), frozenset(kinds), wrong is None


def _some_packets() -> tuple[Context, object, object, list]:
    context = Context(MISSION, TYPES)
    with closing(open_file(ROOT / "samples/captures/f_sbn_disconnect.pcap")) as source:
        batch = next(iter(source.batches()))
    batch = batch.take(np.arange(0, len(batch), max(1, len(batch) // 40)))
    dissector = Dissector(context)
    return (
        context,
        batch,
        ColumnDecoder(context).decode(batch),
        [dissector.dissect(batch[row]) for row in range(len(batch))],
    )


_PACKETS = _some_packets()


def where(data: bytes) -> Hashable:
    """A filter: judged alike packet by packet and in columns, or refused with a mark under the mistake."""
    context, batch, columns, packets = _PACKETS
    text = data[:2000].decode("utf-8", "replace")
    try:
        filter_ = Where(text, context)
    except ConfigError as error:
        return _told(error)
    in_columns, one_by_one = filter_.mask(batch, columns), filter_.judge(packets)
    assert in_columns.tolist() == one_by_one.tolist(), "columns and packets are judged differently"
    return in_columns.tobytes()


def structs(data: bytes) -> Hashable:
    """A layout file: what is read, written and read again is the same; or all of its mistakes."""
    try:
        layout = parse_layout(data, "structs.yaml")
    except ConfigError as error:
        return _told(error)
    again = parse_layout(dumps(layout).encode(), "again")
    assert (again.structs, again.enums, again.bindings) == (layout.structs, layout.enums, layout.bindings)
    return len(layout.structs), len(layout.enums), len(layout.bindings), layout.byte_order


def elf(data: bytes) -> Hashable:
    """A program with debug information: its structs, each in a layout, or one line."""
    with tempfile.NamedTemporaryFile(suffix=".o") as file:
        file.write(data)
        file.flush()
        try:
            info = DebugInfo(file.name)
            listed = info.list()
        except ConfigError as error:
            return _told(error, file.name)
        told = []
        for item in listed[:4]:
            try:
                layout = take(info, [item.name], {}, None).layout
            except ConfigError as error:
                told.append(_told(error, file.name, item.name))
            else:
                parse_layout(dumps(layout).encode(), "again")
                told.append(str(len(layout.structs)))
    return len(listed), tuple(told), info.byte_order


def scenario(data: bytes) -> Hashable:
    """A scenario: a plan that says itself again, or all of its mistakes."""
    with tempfile.NamedTemporaryFile(suffix=".yaml") as file:
        file.write(data)
        file.flush()
        try:
            plan = load_scenario(Path(file.name))
        except ConfigError as error:
            return _told(error, file.name)
    plan.start()
    return tuple(sorted(rule.kind.name for rule in plan.rules)), plan.seed > 0


def rosbag2(data: bytes) -> Hashable:
    """A bag: its metadata, then its database or recording; all messages of it, or one line."""
    metadata, split, database = data.partition(SPLIT)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if split:
            (folder / "metadata.yaml").write_bytes(metadata)
        (folder / "bag_0.db3").write_bytes(database if split else data)
        try:
            bag = open_rosbag(folder)
            topics = bag.topics()
            assert all(isinstance(word, str) for pair in topics.items() for word in pair)
            count = 0
            for message in bag.messages(topics):
                assert message.topic in topics
                assert isinstance(message.cdr, bytes)
                assert isinstance(message.time_ns, int)
                count += 1
        except CaptureError as error:
            return _told(error, name)
    return len(topics), min(count, 8)


def doctor(data: bytes) -> Hashable:
    """A capture of any kind through the doctor and onto a page, however wrong its times and packets are."""
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        file.write(data)
        file.flush()
        context = Context(MISSION, TYPES)
        examination, failed = Examination(context), ""
        try:
            with closing(open_file(file.name)) as source:
                for batch in source.batches():
                    if len(batch):
                        examination.add(batch, ColumnDecoder(context).decode(batch))
        except CaptureError as error:
            failed = _told(error, file.name)
    found = examination.diagnose()
    json.dumps(found.as_json())
    text = page(found, "fuzz", Origin("", 0))
    assert all(verdict.start_ns <= verdict.end_ns for verdict in found.verdicts)
    return failed, found.bad, frozenset(verdict.rule for verdict in found.verdicts), len(text) > 30_000


TARGETS: dict[str, Callable[[bytes], Hashable]] = {
    "definition": definition,
    "where": where,
    "structs": structs,
    "elf": elf,
    "scenario": scenario,
    "rosbag2": rosbag2,
    "doctor": doctor,
}
