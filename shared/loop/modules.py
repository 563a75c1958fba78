"""Finds the module of a service. It is one of Saccade's, or a module from outside that the configuration puts in its
place."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import NamedTuple

from saccade.shared.bus.topics import Topic
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.service import Core, Service

SOURCES = ("simulator", "camera")  # a run has one of them, and `services.source` replaces it
EXAMPLE = "the guide's page 'Your own service' shows how"


class ServiceModule(NamedTuple):
    """A service's declaration, and the function that builds its core."""

    service: Service
    build: Callable[[Config], Core]


def _slot(name: str) -> str:
    return "source" if name in SOURCES else name


def chosen_module(name: str, config: Config) -> str | None:
    """Returns the module that the configuration puts in the place of the service of that name. None if it is ours."""
    return getattr(config.services, _slot(name), None)


def load(name: str, config: Config, *, compare: bool = True) -> ServiceModule:
    """Returns the service that has this name in a run.

    Raises SaccadeError if the configuration names a module that cannot be imported, that has no SERVICE or no function
    `build`, or whose declaration does not fit the service that it replaces. With `compare=False` the last check is left
    out. A process then need not import Saccade's own module, once it is known that the two agree.
    """
    ours = f"saccade.services.{name}.core"
    chosen = chosen_module(name, config)
    if chosen is None:
        module = import_module(ours)
        return ServiceModule(module.SERVICE, module.build)
    told = f"services.{_slot(name)}: module {chosen!r}"
    try:
        module = import_module(chosen)
    except Exception as error:  # a module from outside may raise anything when it is imported
        raise SaccadeError(f"{told} cannot be imported {_why(error, chosen)}") from error
    service, build = getattr(module, "SERVICE", None), getattr(module, "build", None)
    if not isinstance(service, Service):
        raise SaccadeError(f"{told} declares no SERVICE (a saccade.shared.loop.service.Service): {EXAMPLE}")
    if not callable(build):
        raise SaccadeError(f"{told} has no build(config) that makes its core: {EXAMPLE}")
    if compare:
        _require_alike(told, service, import_module(ours).SERVICE)
    return ServiceModule(service, partial(_built, told, build))


def _why(error: Exception, chosen: str) -> str:
    """Returns why a module cannot be imported, where, and what to do."""
    said = error.msg if isinstance(error, SyntaxError) else str(error)
    why = re.sub(r"\s+", " ", said) or type(error).__name__
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing and f"{chosen}.".startswith(f"{missing}."):
        return f"({why}): install it, or put its folder on PYTHONPATH"
    file, line = "its file", None
    if isinstance(error, SyntaxError):
        file, line = error.filename or file, error.lineno
    for frame in traceback.extract_tb(error.__traceback__) if line is None else ():
        if not frame.filename.startswith("<"):  # Python's own importer
            file, line = frame.filename, frame.lineno
    return f"({why}, in {file}, line {line}): " + (f"install {missing}, or repair it" if missing else "repair it")


def _built(told: str, build: Callable[[Config], Core], config: Config) -> Core:
    """Builds the core of a module from outside. Raises SaccadeError if it is none."""
    core = build(config)
    lacks = [name for name in ("begin", "step") if not callable(getattr(core, name, None))]
    if lacks:
        raise SaccadeError(f"{told}: build(config) returns {type(core).__name__}, which has no method "
                           f"{' and no method '.join(lacks)}: return a core; {EXAMPLE}")
    return core


def _require_alike(told: str, service: Service, ours: Service) -> None:
    """Checks what other services rely on: the name, the outputs, the trigger, and how episodes are closed. Raises
    SaccadeError if one of them does not fit."""
    if service.name != ours.name:
        raise SaccadeError(f"{told} calls itself {service.name!r}: it stands in the place of {ours.name!r}, call it so")
    left_out = set(ours.outputs) - set(service.outputs)
    if not set(service.outputs) <= set(ours.outputs) or not all(topic.optional for topic in left_out):
        raise SaccadeError(f"{told} declares the outputs {_names(service.outputs)}: the {ours.name} has "
                           f"{_names(ours.outputs)}")
    if service.trigger not in service.inputs:
        raise SaccadeError(f"{told} declares the trigger {service.trigger.name}, which is none of its inputs "
                           f"{_names(service.inputs)}")
    if service.closed_by != ours.closed_by:
        raise SaccadeError(f"{told} must declare closed_by {ours.closed_by and ours.closed_by.name}, as the "
                           f"{ours.name} does")


def _names(topics: tuple[Topic, ...]) -> str:
    return ", ".join(sorted(topic.name for topic in topics)) or "none"
