"""Options of commands, made from the settings of a run: a field of `RunConfig` is an option."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import wraps
from typing import Annotated, Any, TypeAlias, get_args, get_origin

import typer

from shiftsim.runs.config import RunConfig, parse_argument

Settings: TypeAlias = dict[str, Any]
_FIELDS = {item.name: item for item in fields(RunConfig)}
ALL = tuple(_FIELDS)
_KIND = inspect.Parameter.KEYWORD_ONLY  # those with a default may come first


def with_settings(
    *names: str, **helps: str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of settings, at the place of its parameter `settings`.

    The command gets those that were given, as `RunConfig` wants them; arguments of planners are
    texts still, for `planner_arguments`.

    Args:
        names: The settings, in the order of the help.
        helps: Another help text for some of them.
    """
    options = [_option(name, helps.get(name)) for name in names]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        parameters: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command).parameters.items():
            parameters += options if name == "settings" else [parameter.replace(kind=_KIND)]

        @wraps(command)
        def call(**values: Any) -> None:
            raw = {name: values.pop(name) for name in names}
            settings = {n: _parsed(n, value) for n, value in raw.items() if value not in (None, [])}
            command(settings=settings, **values)

        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        return call

    return decorate


def _option(name: str, text: str | None) -> inspect.Parameter:
    item = _FIELDS[name]
    option = item.metadata["option"]
    kind: Any = item.type
    if get_origin(kind) is dict or (get_origin(kind) is tuple and not option.parse):
        kind = list[get_args(kind)[0]]  # type: ignore[misc]
    elif option.parse:
        kind = str
    flags = option.flags or ((f"--{name.replace('_', '-')}",) if kind is bool else ())
    return inspect.Parameter(
        name,
        _KIND,
        default=None,
        annotation=Annotated[kind | None, typer.Option(*flags, help=text or option.help)],
    )


def _parsed(name: str, value: Any) -> Any:
    parse = _FIELDS[name].metadata["option"].parse
    return parse(value) if parse else value


def planner_arguments(
    texts: Sequence[str], before: Mapping[str, Any], planners: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Arguments by planner, those of the command line put over what a file says."""
    arguments = {name: dict(table) for name, table in before.items()}
    for text in texts:
        owner, name, value = parse_argument(text, tuple(planners))
        arguments.setdefault(owner, {})[name] = value
    return arguments
