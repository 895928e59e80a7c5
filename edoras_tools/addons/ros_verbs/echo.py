"""Messages as ``ros2 topic echo`` prints them: YAML or CSV, long values cut.

A float32 number is printed with the digits of the equal double, as rclpy prints it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from typer import Option

from edoras_tools.cli import options
from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import MessageField, Shape

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.ros import TypeStore

_USUAL_LENGTH: Final = 128
_ELLIPSIS: Final = "..."
_ROSIDL_NAMES: Final = {
    "float64": "double",
    "float32": "float",
    "bool": "boolean",
    "byte": "octet",
    "char": "uint8",
}
"""Names of element types in the output of ``--no-arr``."""


class TextOptions(NamedTuple):
    """Form and length of a printed message."""

    field: Annotated[str | None, Option(help="Only this part, e.g. pose.position.")] = None
    csv: Annotated[bool, Option("--csv", help="Values alone, with commas.")] = False
    full_length: Annotated[bool, Option("--full-length", "-f", help="Long values whole.")] = False
    truncate_length: Annotated[
        int | None, Option("--truncate-length", "-l", parser=options.count, help="Cut them here; 128.")
    ] = None
    no_arr: Annotated[bool, Option("--no-arr", help="Name arrays, without values.")] = False
    no_str: Annotated[bool, Option("--no-str", help="Give the length of strings alone.")] = False
    flow_style: Annotated[bool, Option("--flow-style", help="YAML in one line.")] = False
    raw: Annotated[bool, Option("--raw", help="The bytes, as Python writes them.")] = False
    message_info: Annotated[
        bool, Option("--include-message-info", help="Also times, and the publisher's number.")
    ] = False

    def text(self, types: TypeStore, type_name: str, cdr: bytes) -> str:
        """Return a message as text, without a separator.

        Raises:
            ConfigError: the type has no such field.
            WireError: the message does not fit its type.
        """
        import yaml

        value: Any = types.decode(type_name, cdr)
        kind = type_name
        for name in filter(None, (self.field or "").split(".")):
            fields = {item.name: item for item in types.fields(kind)} if isinstance(value, dict) else {}
            if name not in fields:
                hint = f"; there are {', '.join(fields)}" if fields else ""
                raise ConfigError(f"--field {self.field}: {kind} has no field {name!r}{hint}")
            value, kind = value[name], fields[name].type
        prepared = self._prepared(types, kind, value)
        if self.csv:
            return ",".join(_cells(prepared)) + "\n"
        text: str = yaml.dump(
            prepared, allow_unicode=True, sort_keys=False, width=1 << 30, default_flow_style=self.flow_style
        )
        return text if isinstance(prepared, dict | list) else text.removesuffix("...\n")

    def _prepared(self, types: TypeStore, kind: str, value: Any) -> Any:
        """Return a value for YAML, cut if it is long."""
        most = None if self.full_length else self.truncate_length or _USUAL_LENGTH
        if isinstance(value, dict):
            return {item.name: self._member(types, item, value[item.name]) for item in types.fields(kind)}
        if isinstance(value, str) and self.no_str:
            return f"<string length: <{len(value)}>>"
        if isinstance(value, str):
            return value if len(cut := value[:most]) == len(value) else cut + _ELLIPSIS
        if isinstance(value, list | bytes):
            some = [self._prepared(types, kind, item) for item in value[:most]]
            return some + [_ELLIPSIS] * (len(some) < len(value))
        return value

    def _member(self, types: TypeStore, item: MessageField, value: Any) -> Any:
        if not self.no_arr or item.shape is Shape.SCALAR:
            return self._prepared(types, item.type, value)
        kind = _ROSIDL_NAMES.get(item.type, item.type)
        if item.shape is Shape.ARRAY:
            return f"<array type: {kind}[{len(value)}]>"
        bound = f"[{item.size}]" if item.size else ""
        return f"<sequence type: {kind}{bound}, length: {len(value)}>"


def _cells(value: Any) -> Iterator[str]:
    """Yield the values of a message, one for each cell of CSV."""
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _cells(item)
    else:
        yield str(value)
