"""Generates a library: selects the types and makes the text of each file.

The header of a package has its structs, constants and functions. There are also the files of a mission for
cFS (MsgIds, packet structs and the table of Telemetry Output), and the generator: a small cFS app that
publishes on command, so that ``edoras sweep`` can measure any cFS.
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.addons.codegen.layout import (
    LINE_WIDTH,
    MARK,
    banner,
    for_cpp,
    function,
    guarded,
    loop,
    statement,
)
from edoras_tools.addons.codegen.names import c_type_name, comment, constant_name, literal
from edoras_tools.addons.codegen.plan import (
    SEQUENCES_DEFAULT,
    STRINGS_DEFAULT,
    Bounds,
    CLibrary,
    CMember,
    Message,
    plan_messages,
    utf16,
)
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.mission import Mission, Route
from edoras_tools.ros.store import USUAL_DISTRO
from edoras_tools.ros.types.schema import full_name
from edoras_tools.wire.envelope import EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.ccsds import MsgIds

_ABOUT: Final = """\
/**
 * For every message type T, named as rosidl names it:
 *
 *     T__init     gives a message the default values of its definition.
 *     T__encode   writes a message to a buffer of a given size, encapsulation and body, little-endian; gives
 *                 the length. T__MAX_CDR bytes are always enough.
 *     T__decode   reads a message of either byte order; where the status is not EDORAS_OK, the message has
 *                 its default values.
 *     T__write    and T__read do the same inside a message that nests T; neither takes NULL.
 *
 * A sequence is a count, size, and as many elements of data as its bound; a string likewise, and ends in NUL.
 * A size above the bound is EDORAS_BOUND to encode, from wherever it came.
 */
"""
UMBRELLA: Final = "edoras_core/messages.h"
"""Header that includes those of all packages."""
_C_TYPES: Final = {"bool": "bool", "float32": "float", "float64": "double"}


def header_name(package: str) -> str:
    """Return the header of a package; in a folder, so that its name differs from all headers of the app."""
    return f"edoras_msgs/{package}.h"


def package_header(library: CLibrary, package: str, command: str) -> str:
    """Return the text of a package's header."""
    messages = library.of(package)
    includes = ["edoras_core/cdr.h", *(header_name(item) for item in library.uses(package))]
    body = "".join(f'#include "{item}"\n' for item in includes) + "\n"
    body += for_cpp("\n".join(_message(message) for message in messages))
    return banner(command, f"The messages of {package}.", messages) + guarded(header_name(package), body)


def umbrella(library: CLibrary, command: str) -> str:
    """Return the text of the header that includes all others."""
    body = _ABOUT + "".join(f'#include "{header_name(package)}"\n' for package in library.packages)
    return banner(command, "Every message.") + guarded(UMBRELLA, body)


def heads(name: str) -> dict[str, str]:
    """Return the declaration of each function of a message."""
    return {
        "init": f"void {name}__init({name} *message)",
        "encode": f"edoras_status_t {name}__encode(const {name} *message, uint8_t *buffer, size_t size, "
        "size_t *length)",
        "decode": f"edoras_status_t {name}__decode({name} *message, const uint8_t *cdr, size_t length)",
        "write": f"void {name}__write(edoras_writer_t *writer, const {name} *message)",
        "read": f"void {name}__read(edoras_reader_t *reader, {name} *message)",
    }


def _message(message: Message) -> str:
    """Return the part of a header for one message."""
    name = message.name
    members = "".join(f"    {_struct_member(member)}\n" for member in message.members)
    constants = "".join(
        f"#define {constant_name(message.ros_name, item.name)} {literal(item.type, item.value)}\n"
        for item in message.definition.constants
        if item.type != "wstring"
    )
    declared = "".join(statement(f"{head};", 0) for head in heads(name).values())
    return f"""\
/** {message.ros_name} */
typedef struct {{
{members}}} {name};

{constants}{constants and chr(10)}\
/** Bytes of the longest CDR of {message.ros_name}, encapsulation included. */
#define {name}__MAX_CDR {message.most_bytes}U

{declared}"""


def c_type(member: CMember) -> str:
    """Return the C type of a number or a nested message."""
    if member.message:
        return member.message.name
    return _C_TYPES.get(member.kind) or f"{member.kind}_t"


def _struct_member(member: CMember) -> str:
    one = f"{c_type(member)} {{}};"
    if member.characters:
        unit = "char" if member.kind == "string" else "uint16_t"
        one = f"struct {{{{ uint32_t size; {unit} data[{member.characters + 1}]; }}}} {{}};"
    if member.is_sequence:
        inner = one.format(f"data[{member.elements}]")
        declared = f"struct {{ uint32_t size; {inner} }} {member.name};"
    else:
        declared = one.format(f"{member.name}[{member.elements}]" if member.elements else member.name)
    is_plain = not member.elements and not member.characters and member.ros.type == member.kind
    says_itself = member.message is not None or is_plain
    return declared if says_itself else f"{declared} /**< {comment(member.ros.type_text)} */"


_ONE_BY_ONE: Final = frozenset({"bool", "string", "wstring", "message"})
"""Kinds whose arrays are not copied at once: any byte other than 0 is true."""


def codec(library: CLibrary, package: str, command: str) -> str:
    """Return the text of a package's ``.c`` file."""
    messages = library.of(package)
    head = banner(command, f"The messages of {package}: default values, CDR to and fro.", messages)
    includes = f'#include "{header_name(package)}"\n\n#include <string.h>\n'
    functions = (_init, partial(_stream, verb="read"), partial(_stream, verb="write"), _decode, _encode)
    return "\n".join([head + includes, *(make(item) for item in messages for make in functions)])


def _init(message: Message) -> str:
    arrays = [
        f"static const {c_type(member)} {member.name}_default[{len(member.ros.default)}] = "
        f"{{{', '.join(literal(member.ros.type, item) for item in member.ros.default)}}}"
        for member in message.members
        if member.ros.default and member.elements and not member.characters
    ]
    wide = [
        f"static const uint16_t {name}_default[] = {{{', '.join(f'{unit}U' for unit in (*utf16(text), 0))}}}"
        for member in message.members
        if member.kind == "wstring"
        for name, text in _texts(member)
    ]
    loops = any(
        member.message and member.message.has_defaults and member.elements and not member.is_sequence
        for member in message.members
    )
    variables = [*arrays, *wide, *["uint32_t i"] * loops]
    body = "    (void)memset(message, 0, sizeof(*message));\n"
    body += "".join(_default(member) for member in message.members)
    return function(heads(message.name)["init"], variables, body)


def _default(member: CMember) -> str:
    """Return the statements that give a field its default value, after all is set to zero."""
    place, default = f"message->{member.name}", member.ros.default
    if member.message:
        if not member.message.has_defaults or member.is_sequence:
            return ""
        call = f"{member.message.name}__init(&{place}{{}});"
        if member.elements:
            return loop(f"EDORAS_CAPACITY({place})", call.format("[i]"))
        return statement(call.format(""))
    if default is None:
        return ""
    data = f"{place}.data" if member.is_sequence else place
    text = statement(f"{place}.size = {len(default)}U;") if member.is_sequence else ""
    if member.characters:
        return text + "".join(
            _default_text(member, f"{data}[{number}]" if member.elements else place, name, value)
            for number, (name, value) in enumerate(_texts(member))
        )
    if member.elements:
        copied = f"(void)memcpy({data}, {member.name}_default, sizeof({member.name}_default));"
        return text + (statement(copied) if default else "")
    return statement(f"{place} = {literal(member.ros.type, default)};")


def _texts(member: CMember) -> list[tuple[str, str]]:
    """Return the default strings of a field, each with a name."""
    default = member.ros.default
    if not member.elements:
        return [(member.name, default)] if default is not None else []
    return [(f"{member.name}_{number}", item) for number, item in enumerate(default or [])]


def _default_text(member: CMember, place: str, name: str, value: str) -> str:
    if member.kind == "string":
        return statement(f"(void)EDORAS_SET_STRING({place}, {literal('string', value)});")
    copied = f"(void)memcpy({place}.data, {name}_default, sizeof({name}_default));"
    return statement(f"{place}.size = {len(utf16(value))}U;") + statement(copied)


def _stream(message: Message, verb: str) -> str:
    """Return the function that reads or writes the members of a message."""
    counts = verb == "write" and any(member.is_sequence for member in message.members)
    loops = any(member.elements and member.kind in _ONE_BY_ONE for member in message.members)
    variables = ["uint32_t count"] * counts + ["uint32_t i"] * loops
    body = "".join(_member(item, verb) for item in message.members)
    return function(heads(message.name)[verb], variables, body)


def _read_one(member: CMember, place: str) -> str:
    if member.message:
        return f"{member.message.name}__read(reader, &{place});"
    if member.characters:
        data = f"{place}.data"
        return f"{place}.size = edoras_read_{member.kind}(reader, {data}, EDORAS_CAPACITY({data}));"
    return f"{place} = edoras_read_{member.kind}(reader);"


def _member(member: CMember, verb: str) -> str:
    """Return the statements that read or write a member."""
    place, stream = f"message->{member.name}", {"read": "reader", "write": "writer"}[verb]
    one = _read_one if verb == "read" else _write_one
    if not member.elements:
        return statement(one(member, place))
    data, limit, text = place, f"EDORAS_CAPACITY({place})", ""
    if member.is_sequence:
        data, size = f"{place}.data", f"{place}.size"
        limit, argument = (size, "") if verb == "read" else ("count", f"{size}, ")
        text = statement(f"{limit} = edoras_{verb}_count({stream}, {argument}EDORAS_CAPACITY({data}));")
    if member.kind not in _ONE_BY_ONE:
        return text + statement(f"edoras_{verb}_many({stream}, {data}, {limit}, sizeof({data}[0]));")
    return text + loop(limit, one(member, f"{data}[i]"))


def _write_one(member: CMember, place: str) -> str:
    if member.message:
        return f"{member.message.name}__write(writer, &{place});"
    if member.characters:
        data = f"{place}.data"
        return f"edoras_write_{member.kind}(writer, {data}, {place}.size, EDORAS_CAPACITY({data}));"
    return f"edoras_write_{member.kind}(writer, {place});"


def _decode(message: Message) -> str:
    name = message.name
    body = f"""\
    if (message != NULL) {{
        edoras_reader_t reader;

        edoras_reader_open(&reader, cdr, length);
        {name}__read(&reader, message);
        status = edoras_reader_close(&reader, {message.most_trailing}U);
        if (status != EDORAS_OK) {{
            {name}__init(message);
        }}
    }}
    return status;
"""
    return function(heads(name)["decode"], ["edoras_status_t status = EDORAS_ARGUMENT"], body)


def _encode(message: Message) -> str:
    name = message.name
    body = f"""\
    edoras_writer_open(&writer, (message == NULL) ? NULL : buffer, size);
    if (message != NULL) {{
        {name}__write(&writer, message);
    }}
    return edoras_writer_close(&writer, length);
"""
    return function(heads(name)["encode"], ["edoras_writer_t writer"], body)


MSGIDS: Final = "edoras_mission/msgids.h"
_PACKETS_FILE: Final = "edoras_mission/packets.h"
_SUBSCRIPTIONS_FILE: Final = "edoras_mission/to_lab_subs.inc"
_LIMIT: Final = 4
"""Messages of one MsgId that may wait in TO_LAB's pipe, as in its own table."""


def side_files(mission: Mission, command: str) -> dict[str, str]:
    """Return the text of each file by its name; none for a mission without routes."""
    if not mission.routes:
        return {}
    routes = _by_key(mission.routes)
    return {
        MSGIDS: _msgids(routes, command),
        _PACKETS_FILE: _packets(routes, command, mission.msg_ids),
        _SUBSCRIPTIONS_FILE: _subscriptions(routes, command),
    }


def _by_key(routes: Sequence[Route]) -> dict[str, Route]:
    """Return each route under a unique name: key, side, and the MsgId if two names would be equal."""
    plain = [_plain(route) for route in routes]
    often = Counter(plain)
    return {
        name if often[name] == 1 else f"{name}_{route.msg_id:04X}": route
        for name, route in zip(plain, routes, strict=True)
    }


def _plain(route: Route) -> str:
    side = route.link.bridge.upper()
    return f"EDORAS_MISSION_{re.sub(r'[^A-Za-z0-9]+', '_', route.key).strip('_').upper()}_{side}"


def _msgids(routes: dict[str, Route], command: str) -> str:
    widest = max(map(len, routes))
    lines = [
        f"#define {name}_MID{' ' * (widest - len(name))} 0x{route.msg_id:04X} /**< {_about(route)} */\n"
        for name, route in routes.items()
    ]
    received = [f"{name}_MID" for name, route in routes.items() if route.to_cfs]
    listed = ", \\\n      ".join(received)
    subscribed = f"""
/** What the app subscribes to with CFE_SB_Subscribe: commands from the ground, state from the flight side. */
#define EDORAS_MISSION_SUBSCRIPTIONS \\
    {{ {listed} }}
"""
    about = "The MsgIds of the mission: what ROS topic and type each carries, and where it comes from."
    return banner(command, about) + guarded(MSGIDS, "".join(lines) + subscribed * bool(received))


def _about(route: Route) -> str:
    way = f"from {route.link.name}" if route.to_cfs else f"to {route.link.name}"
    return comment(f"{way}: {route.topic}, {route.type}")


def _packets(routes: dict[str, Route], command: str, msg_ids: MsgIds) -> str:
    body = f'#include "cfe.h"\n#include "{MSGIDS}"\n#include "{UMBRELLA}"\n'
    for name, route in routes.items():
        if not route.to_cfs:
            command_sent = msg_ids.is_command(route.msg_id)
            kind, head = ("Command", "CmdHeader") if command_sent else ("Telemetry", "TlmHeader")
            body += f"""
/** 0x{route.msg_id:04X}, {_about(route)} */
typedef struct
{{
    CFE_MSG_{kind}Header_t {head};
    uint8_t data[(2U * EDORAS_ENVELOPE_WORD) + {c_type_name(route.type)}__MAX_CDR];
}} {"".join(map(str.capitalize, name.split("_")))}_t;
"""
    about = (
        "The packets that the app sends, with space for the longest message. A packet that is sent whole\n"
        "takes that space on the link; CFE_MSG_SetSize before CFE_SB_TransmitMsg makes it as long as it is."
    )
    return banner(command, about) + guarded(_PACKETS_FILE, body)


def _subscriptions(routes: dict[str, Route], command: str) -> str:
    sent = [name for name, route in routes.items() if route.link.only_from_cfs and not route.to_cfs]
    rows = "".join(f"{{CFE_SB_MSGID_WRAP_VALUE({name}_MID), {{0, 0}}, {_LIMIT}}},\n" for name in sent)
    about = (
        f'Entries of TO_LAB\'s table: #include "{MSGIDS}" on top of to_lab_sub.c, and this file\n'
        " * inside TO_LAB_Subs, before its last entry. The last number is how many may wait in TO_LAB's pipe."
    )
    return banner(command, about) + rows


RUNTIME: Final = Path(__file__).parent / "runtime"
"""Folder of the C files that every library contains: CDR, and the functions of edoras_core."""
_CONFIG: Final = "edoras_core/config.h"
POOL_DEFAULT: Final = 4
MOST_POOLED: Final = 1024


class LibraryOrder(msgspec.Struct, frozen=True):
    """The options of a library.

    Attributes:
        types: names, as ``geometry_msgs/msg/Twist`` or ``geometry_msgs/Twist``, or whole packages.
        bounds: bounds of sequences and strings.
        mission: mission whose types are added, and its tables for cFS.
        pool: number of messages of a type that may be in use at once: edoras_core takes them from a pool in
            place of a heap.
        envelope: name of the format of the EDORAS envelope, see ``wire.envelope``.
        keep_values: whether a failing ``get_`` function leaves the app's variable unchanged; else it writes
            0.
    """

    types: Sequence[str] = ()
    bounds: Bounds = Bounds()
    mission: Mission = Mission()
    pool: int = POOL_DEFAULT
    envelope: EnvelopeFormat = EnvelopeFormat()
    keep_values: bool = False


class Generated(msgspec.Struct, frozen=True):
    """A library in C.

    Attributes:
        library: messages.
        files: texts of the files by name.
    """

    library: CLibrary
    files: dict[str, str]


def generate(types: TypeStore, order: LibraryOrder) -> Generated:
    """Make a library.

    Raises:
        RouteError: a type is not known.
        ConfigError: no type is named, or an option cannot be applied.
    """
    type_names = [*_type_names(types, order.types), *(route.type for route in order.mission.routes)]
    if not type_names:
        raise ConfigError("no message type is named: give types, packages, or a mission with -c")
    if not 1 <= order.pool <= MOST_POOLED:
        raise ConfigError(f"--pool: {order.pool} is not from 1 to {MOST_POOLED}")
    library, command = plan_messages(types, type_names, order.bounds), _command(types, order)
    files = {
        path.relative_to(RUNTIME).as_posix(): banner(command) + path.read_text(encoding="utf-8")
        for path in sorted(RUNTIME.rglob("*.[ch]"))
    }
    files[_CONFIG] = _config(order, command)
    files[UMBRELLA] = umbrella(library, command)
    files["edoras_types.c"] = tables(library, command)
    files |= side_files(order.mission, command)
    for package in library.packages:
        files[header_name(package)] = package_header(library, package, command)
        files[f"edoras_msgs_{package}.c"] = codec(library, package, command)
    return Generated(library, files)


def _command(types: TypeStore, order: LibraryOrder) -> str:
    """Return the command line that makes the same files, without the folders."""
    words = ["edoras", "codegen", *order.types]
    words += [word for name in sorted(order.mission.files) for word in ("-c", name)]
    words += [word for rule in order.bounds.rules for word in ("--bound", rule.text)]
    for option, value, default in (
        ("--bound strings=", order.bounds.strings, STRINGS_DEFAULT),
        ("--bound sequences=", order.bounds.sequences, SEQUENCES_DEFAULT),
        ("--pool ", order.pool, POOL_DEFAULT),
        ("--set envelope=", str(order.envelope), str(EnvelopeFormat())),
        ("--set distro=", types.distro, USUAL_DISTRO),
    ):
        words += f"{option}{value}".split(" ", 1) if value != default else []
    words += ["--keep-values"] * order.keep_values
    return shlex.join(words)


def _config(order: LibraryOrder, command: str) -> str:
    body = f"""\
/** Messages, and buffers, of each type that create_msg and its like hand out in turn. */
#define EDORAS_POOL {order.pool}U

/** Bytes of each of the two lengths of the EDORAS envelope, and whether their first byte is the highest. */
#define EDORAS_ENVELOPE_WORD {order.envelope.width}
#define EDORAS_ENVELOPE_BIG_ENDIAN {int(order.envelope.byte_order == "big")}

/** Whether a get_ function that fails leaves the app's variable as it was; otherwise it writes 0. */
#define EDORAS_KEEP_VALUES {int(order.keep_values)}
"""
    return banner(command, "What the library was made for.") + guarded(_CONFIG, body)


def _type_names(types: TypeStore, names: Iterable[str]) -> list[str]:
    """Return the types of some names and packages.

    Raises:
        RouteError: a package has no type.
    """
    selection = []
    for name in names:
        if "/" in name:
            selection.append(full_name(name))
            continue
        of_package = [item for item in types.types() if item.startswith(f"{name}/msg/")]
        if not of_package:
            raise RouteError(
                f"no package {name!r} of messages is known; write geometry_msgs/msg/Twist or geometry_msgs"
            )
        selection += of_package
    return selection


_INCLUDES: Final = f'#include "{UMBRELLA}"\n#include "edoras_core/tables.h"\n'


def tables(library: CLibrary, command: str) -> str:
    """Return the text of the file with the tables."""
    about = "Every field by its name, for the functions of edoras_core, and the pools behind create_msg."
    pooled_names = {message.ros_name for message in library.requested}
    parts = [banner(command, about) + _INCLUDES]
    parts += [_table(message, pooled=message.ros_name in pooled_names) for message in library.messages]
    listed = sorted(
        library.messages, key=lambda message: (message.package, message.short_name, message.ros_name)
    )
    rows = "".join(f'    {{"edoras_codegen", &{message.name}__type}},\n' for message in listed)
    parts.append(
        f"const TypeSupport_t edoras_types[] = {{\n{rows}}};\n\n"
        "const size_t edoras_types_count = EDORAS_CAPACITY(edoras_types);\n"
    )
    return "\n".join(parts)


def _table(message: Message, *, pooled: bool) -> str:
    name = message.name
    rows = "".join(_row(name, member) for member in sorted(message.members, key=lambda item: item.ros.name))
    return f"""\
EDORAS_FUNCTIONS({name})

static const MemberInfo_t {name}__members[] = {{
{rows}}};

{f"EDORAS_MAKE_POOL({name}){chr(10) * 2}" if pooled else ""}\
static const TypeInfo_t {name}__type = {{
    "{message.package}",
    "{message.short_name}",
    {len(message.members)}U,
    sizeof({name}),
    EDORAS_BUFFER_SIZE({name}),
    {name}__members,
    {name}__init_any,
    {name}__encode_any,
    {name}__decode_any,
    {f"&{name}__pool" if pooled else "NULL"},
}};
"""


def _row(owner: str, member: CMember) -> str:
    shape = "EDORAS_SEQUENCE" if member.is_sequence else "EDORAS_ARRAY" if member.elements else "EDORAS_ONE"
    nested = f"&{member.message.name}__type" if member.message else "NULL"
    length = member.characters + 1 if member.characters else 0
    head = f'    {{"{member.ros.name}", EDORAS_KIND_{member.kind.upper()}, '
    head += f"{'true' if member.is_sequence else 'false'}, {length}U, {nested},"
    where = f"{shape}({owner}, {member.name})}},\n"
    return f"{head} {where}" if len(head) + len(where) < LINE_WIDTH else f"{head}\n     {where}"


STARTUP: Final = "CFE_APP, edoras_gen, EDORAS_GEN_Main, EDORAS_GEN, 80, 32768, 0x0, 0;"
"""Line of ``cfe_es_startup.scr`` that starts the app."""
_SOURCES: Final = Path(__file__).parent / "generator_app"
_MSGIDS: Final = "fsw/inc/edoras_gen_msgids.h"


def generator_app(msg_id: int) -> dict[str, str]:
    """Return the text of each file of the app by its name.

    Raises:
        ConfigError: the MsgId is not one of a command.
    """
    if not 0x1800 <= msg_id <= 0x1FFF:
        raise ConfigError(f"--generator 0x{msg_id:04x}: a command's MsgId is from 0x1800 to 0x1fff")
    command = f"edoras codegen generator --generator 0x{msg_id:04X}"
    head = banner(command, f"Its line in cfe_es_startup.scr:\n\n    {STARTUP}")
    cmake = (_SOURCES / "CMakeLists.txt").read_text(encoding="utf-8")
    defined = f"#define EDORAS_GEN_CMD_MID 0x{msg_id:04X} /**< obeyed: function codes 0 and 2 */\n"
    return {
        "CMakeLists.txt": f"# {MARK}: {command}\n{cmake}",
        "fsw/src/edoras_gen.c": head + (_SOURCES / "edoras_gen.c").read_text(encoding="utf-8"),
        _MSGIDS: banner(command) + guarded("edoras_gen_msgids.h", defined),
    }
