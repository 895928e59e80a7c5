"""Groups of options: a command takes options that belong together as one value.

Commands are functions whose parameters are declared as Typer requires, with
``Annotated[..., typer.Option(...)]``. Typer has no groups; this file adds them:

1. Options that belong together are the fields of a ``NamedTuple``, with their declarations and defaults.
   ``grouped`` lets a command take such a group as one value. A method of the group returns the value that
   pipelines take.
2. ``headed`` gives a group its own heading in help texts, Typer's ``rich_help_panel``.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from functools import cache, wraps
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

_Group = TypeVar("_Group", bound=type)


def headed(text: str) -> Callable[[_Group], _Group]:
    """Give a group of options its own heading in help texts; groups inside it get the same heading."""

    def mark(group: _Group) -> _Group:
        group.heading = text  # type: ignore[attr-defined]
        return group

    return mark


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take options in groups: a parameter whose type is a ``NamedTuple`` stands for its fields.

    Typer sees an option for each field, in place of the parameter, with the field's name, type and default. A
    field may itself be a group.
    """
    options = list(_options(command))

    @wraps(command)
    def call(**values: Any) -> None:
        _filled(command, values)

    call.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    call.__annotations__ = {item.name: item.annotation for item in options}
    return call


def _options(holder: Callable[..., Any], heading: str = "") -> Iterator[inspect.Parameter]:
    """Yield the options of a command or a group; nested groups are replaced by their options."""
    heading = getattr(holder, "heading", heading)
    for item in parameters(holder):
        if _is_group(item.annotation):
            yield from _options(item.annotation, heading)
        elif heading:
            kind, declared = get_args(item.annotation)
            declared = copy(declared)
            declared.rich_help_panel = heading
            yield item.replace(annotation=Annotated[kind, declared])
        else:
            yield item


def _filled(holder: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    """Call a command, or make a group, with the values of its options."""
    return holder(
        **{
            item.name: _filled(item.annotation, values) if _is_group(item.annotation) else values[item.name]
            for item in parameters(holder)
        }
    )


@cache
def parameters(holder: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return keyword parameters with evaluated annotations, as Typer needs them."""
    hints = get_type_hints(holder, include_extras=True)
    if sys.version_info < (3, 11):  # there a default of None changes ``X`` to ``X | None``
        hints = {
            name: next((item for item in get_args(hint) if hasattr(item, "__metadata__")), hint)
            for name, hint in hints.items()
        }
    return [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[item.name])
        for item in inspect.signature(holder).parameters.values()
    ]


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, tuple)
