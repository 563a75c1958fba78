"""What the texts of a command line mean: a configuration and its values. Loads nothing heavy before it is asked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from saccade.shared.errors import SaccadeError


def configured(path: Path | None, given: dict[str, Any], values: list[str] | None, agent: str) -> Any:
    """The configuration: the agent's, over it the file's, then the options that were given, then `--set`.

    Raises SaccadeError if the agent is unknown, or if a file, a key or a value is wrong.
    """
    from saccade.app.run.registry import agent_of
    from saccade.shared.config import load

    options = {key: value for key, value in given.items() if value is not None}
    config = load(path, agent_of(agent).preset).with_values(options | dict(map(parse_value, values or ())))
    if not is_list(config.scene.objects):
        return config
    from saccade.app.objects.lists import assembled

    return config.with_values({"scene.objects": assembled(config.scene.objects, config.perception.architecture)})


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
