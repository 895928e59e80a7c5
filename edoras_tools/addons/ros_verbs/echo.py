"""Messages as ``ros2 topic echo`` prints them: YAML or CSV, long values cut.

A float32 number is printed with the digits of the equal double, as rclpy prints it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import yaml

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import MessageField, Shape

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.ros import TypeStore

USUAL_LENGTH: Final = 128
_ELLIPSIS: Final = "..."
_ROSIDL_NAMES: Final = {
    "float64": "double",
    "float32": "float",
    "bool": "boolean",
    "byte": "octet",
    "char": "uint8",
}
"""Names of element types in the output of ``--no-arr``."""


class EchoFormat(msgspec.Struct, frozen=True):
    """Form of printed messages.

    Attributes:
        field: path of the printed part, as ``pose.position``; empty for all.
        length: maximum length of arrays and strings; 0: no maximum.
        no_arrays: whether to replace arrays by their type.
        no_strings: whether to replace strings by their type.
        flow: whether YAML is on one line.
        csv: whether to print only values, with commas.
    """

    field: str = ""
    length: int = USUAL_LENGTH
    no_arrays: bool = False
    no_strings: bool = False
    flow: bool = False
    csv: bool = False

    def text(self, types: TypeStore, type_name: str, cdr: bytes) -> str:
        """Return a message as text, without a separator.

        Raises:
            ConfigError: the type has no such field.
            WireError: the message does not fit its type.
        """
        value: Any = types.decode(type_name, cdr)
        kind = type_name
        for name in filter(None, self.field.split(".")):
            fields = {item.name: item for item in types.fields(kind)} if isinstance(value, dict) else {}
            if name not in fields:
                hint = f"; there are {', '.join(fields)}" if fields else ""
                raise ConfigError(f"--field {self.field}: {kind} has no field {name!r}{hint}")
            value, kind = value[name], fields[name].type
        prepared = self._prepared(types, kind, value)
        if self.csv:
            return ",".join(_cells(prepared)) + "\n"
        text: str = yaml.dump(
            prepared, allow_unicode=True, sort_keys=False, width=1 << 30, default_flow_style=self.flow
        )
        return text if isinstance(prepared, dict | list) else text.removesuffix("...\n")

    def _prepared(self, types: TypeStore, kind: str, value: Any) -> Any:
        """Return a value for YAML, cut if it is long."""
        if isinstance(value, dict):
            return {item.name: self._member(types, item, value[item.name]) for item in types.fields(kind)}
        if isinstance(value, str) and self.no_strings:
            return f"<string length: <{len(value)}>>"
        if isinstance(value, str):
            return value[: self.length] + _ELLIPSIS if 0 < self.length < len(value) else value
        if isinstance(value, list | bytes):
            some = [self._prepared(types, kind, item) for item in value[: self.length or None]]
            return some + [_ELLIPSIS] * (len(some) < len(value))
        return value

    def _member(self, types: TypeStore, item: MessageField, value: Any) -> Any:
        if not self.no_arrays or item.shape is Shape.SCALAR:
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
