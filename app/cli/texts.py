"""What the texts of a command line mean: a configuration and its values. Loads nothing heavy before it is asked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from saccade.shared.errors import SaccadeError


def configured(path: Path | None, given: dict[str, Any], values: list[str] | None,
               agent: str | None, *, lying: bool = False) -> tuple[Any, str]:
    """The configuration and the name of its agent: the agent's preset, over it the file's, then the options that were
    given, then `--set`. Without an agent it is the one for such objects and such light, and for objects that lie where
    a suite has such; this is said if it is not the usual one.

    Raises SaccadeError if the agent is unknown, or if a file, a key or a value is wrong.
    """
    from saccade.app.run.registry import OPEN, configuration, reason_for_open

    options = {key: value for key, value in given.items() if value is not None}
    config, name = configuration(path, options | dict(map(parse_value, values or ())), agent, lying=lying)
    if is_list(config.scene.objects):
        from saccade.app.objects.lists import assembled

        objects = assembled(config.scene.objects, config.perception.architecture)
        config = config.with_values({"scene.objects": objects})
    if agent is None and name == OPEN and (why := reason_for_open(config, lying)):
        from saccade.shared.render.objects import names_of

        names_of(config.scene.objects)  # a name that is misspelt is told first
        print(f"the agent is {name}, because {why}: `--agent` names another one")
    return config, name


def is_list(objects: str) -> bool:
    """Whether this names objects, and not one set."""
    return "," in objects or (":" in objects and os.sep not in objects)


def parse_value(text: str) -> tuple[str, Any]:
    """KEY=VALUE as (key, value): JSON where it is JSON, else text."""
    from saccade.shared.files import parse_json

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise SaccadeError(f"--set {text!r}: write KEY=VALUE, such as planner.step_m=0.03")
    try:
        return key, parse_json(value)
    except ValueError:
        return key, value


def split_names(names: str | None) -> list[str] | None:
    """The objects in a,b."""
    return None if names is None else [name.strip() for name in names.split(",") if name.strip()]


def numbers(text: str | None, option: str = "--intrinsics") -> list[float] | None:
    """The numbers in a,b; their count and size are for the caller to check."""
    try:
        return None if text is None else [float(part) for part in text.split(",")]
    except ValueError as error:
        raise SaccadeError(f"{option} {text!r}: write fx,fy,cx,cy, such as 615,615,320,240") from error
