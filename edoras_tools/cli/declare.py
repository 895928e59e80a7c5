"""How a command declares its options and arguments, and takes options in groups.

An option is declared by its annotation, as ``Annotated[Time, "--duration", "Stop after this time."]``:

1. Its type, which may be a kind that several options share (``Time``), with what typer must know of it:
   ``typer.Option(parser=...)``, or ``typer.Argument()`` for an argument. Without that it is an option.
2. How help texts show it, where that does not follow from the rest: its names, then what its value is called,
   as ``"--count -n N"`` or ``"N"``. Its usual name is that of the parameter; ``--no-`` must be named.
3. Its help text.

Options that go together are a ``NamedTuple``, which holds their names, help texts and defaults. ``grouped``
lets a command take such a group as one value; a method of the group makes the value that pipelines take.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from functools import cache, wraps
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import typer
from typer.models import OptionInfo

_Group = TypeVar("_Group", bound=type)


def headed(text: str) -> Callable[[_Group], _Group]:
    """Give a group of options a heading of its own in help texts; groups inside it have the same."""

    def mark(group: _Group) -> _Group:
        group.heading = text  # type: ignore[attr-defined]
        return group

    return mark


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take options in groups: a parameter whose type is a ``NamedTuple`` stands for its fields.

    Typer sees an option for each field, in place of the parameter, with the field's name, type and default. A
    field may itself be a group. Help texts show its options under the group's heading, if it has one.
    """
    options = list(_options(command))

    @wraps(command)
    def call(**given: Any) -> None:
        _filled(command, given)

    call.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    call.__annotations__ = {item.name: item.annotation for item in options}
    return call


def _options(holder: Callable[..., Any], heading: str = "") -> Iterator[inspect.Parameter]:
    """Yield the options of a command or a group; nested groups are replaced by their options."""
    heading = getattr(holder, "heading", heading)
    for item in _parameters(holder):
        if _is_group(item.annotation):
            yield from _options(item.annotation, heading)
        else:
            yield item.replace(annotation=_declared(item.name, item.annotation, heading))


def _declared(name: str, annotation: Any, heading: str) -> Any:
    """Return the annotation that typer takes in place of one of ours."""
    kind, *said = get_args(annotation)
    words = [item for item in said if isinstance(item, str)]
    declared = copy(next((item for item in said if not isinstance(item, str)), None)) or typer.Option()
    *shown, declared.help = words[-2:]
    parts = " ".join(shown).split()
    names: list[str] = []
    if isinstance(declared, OptionInfo):
        names = [item for item in parts if item.startswith("-")]
        declared.param_decls = tuple(names) or (f"--{name.replace('_', '-')}",)
    declared.metavar = " ".join(parts[len(names) :]) or declared.metavar
    if heading:
        declared.rich_help_panel = heading
    return Annotated[kind, declared]


def _filled(holder: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a command, or make a group, with the values of its options."""
    return holder(
        **{
            item.name: _filled(item.annotation, given) if _is_group(item.annotation) else given[item.name]
            for item in _parameters(holder)
        }
    )


@cache
def _parameters(holder: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return keyword parameters with evaluated annotations, as typer needs them."""
    hints = get_type_hints(holder, include_extras=True)
    if sys.version_info < (3, 11):  # there a default of None makes ``X`` to ``X | None``
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
