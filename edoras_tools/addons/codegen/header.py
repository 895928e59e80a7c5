"""The header of a package: its structs, constants and functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.addons.codegen.layout import banner, for_cpp, guarded, statement
from edoras_tools.addons.codegen.names import comment, constant_name, literal

if TYPE_CHECKING:
    from edoras_tools.addons.codegen.plan import CLibrary, CMember, Message

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
    members = "".join(f"    {_member(member)}\n" for member in message.members)
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


def _member(member: CMember) -> str:
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
