"""What a real ROS 2 reads and writes, run by the Python that has its wheels.

Standard input is JSON, type names to a message's CDR in hexadecimal digits. Standard output is JSON, by type:
the ``values`` that ``rclpy.serialization`` reads, what it writes of them ``again``, and a new message of its
``default`` values, as CDR and as values.
"""

import importlib
import json
import sys

from rclpy.serialization import deserialize_message, serialize_message


def plain(value, kind):
    """Return a value of a message as JSON has it, for its type as rosidl spells it."""
    if hasattr(value, "get_fields_and_field_types"):
        return values_of(value)
    if isinstance(value, (bytes, bytearray)):
        return value[0] if kind == "octet" else list(value)
    if isinstance(value, str | bool | int | float):
        return value
    element = kind.removeprefix("sequence<").partition("[")[0].partition(",")[0].removesuffix(">")
    return [plain(item.item() if hasattr(item, "item") else item, element) for item in value]


def values_of(message):
    """Return a message as a dict."""
    kinds = message.get_fields_and_field_types()
    return {name: plain(getattr(message, name), kind) for name, kind in kinds.items()}


def main():
    told = {}
    for name, cdr in json.load(sys.stdin).items():
        package, kind, last = name.split("/")
        message_type = getattr(importlib.import_module(f"{package}.{kind}"), last)
        message, default = deserialize_message(bytes.fromhex(cdr), message_type), message_type()
        told[name] = {
            "values": values_of(message),
            "again": serialize_message(message).hex(),
            "default": values_of(default),
            "default_cdr": serialize_message(default).hex(),
        }
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
