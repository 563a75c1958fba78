"""Which cores make an agent and a world, by name; the processes of a run and the pairs of an in-process run derive from
it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from saccade.app.run.launch import JUDGE
from saccade.app.run.supervisor import VIEWER, Process
from saccade.app.run.threads import limit_torch
from saccade.shared.bus.topics import TRUTH
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.modules import SOURCES, load
from saccade.shared.loop.service import Core, Service

Pair = tuple[Service, Core]

ROUTER, RECORDER = "router", "recorder"


@dataclass(frozen=True)
class World:
    """Where images come from and, maybe, actions go: the service `source`. `judges` hear its truth, where it has one;
    one that is `live` waits for nobody."""

    source: str
    judges: tuple[str, ...] = ()
    live: bool = False


WORLDS = {
    "simulator": World("simulator", judges=(JUDGE,)),
    "camera": World("camera", live=True),
}
DEFAULT_WORLD = "simulator"


@dataclass(frozen=True)
class Agent:
    """`services` are processes of their own; `cores` are modules that run within one alone."""

    services: tuple[str, ...] = ()
    cores: tuple[str, ...] = ()
    weights: bool = True  # whether it needs trained ones


AGENTS = {
    "sceneccn": Agent(services=("perception", "belief", "planner")),
    "oracle": Agent(cores=("saccade.services.planner.oracle",), weights=False),
}


def agent_of(name: str) -> Agent:
    """The agent of that name; raises SaccadeError for an unknown one."""
    if name not in AGENTS:
        raise SaccadeError(f"agent {name!r} is unknown: choose from {', '.join(AGENTS)}")
    return AGENTS[name]


def world_of(name: str) -> World:
    """The world of that name; raises SaccadeError for an unknown one."""
    if name not in WORLDS:
        raise SaccadeError(f"world {name!r} is unknown: choose from {', '.join(WORLDS)}")
    return WORLDS[name]


def agent_pairs(agent: str, config: Config) -> list[Pair]:
    """Declarations and cores of an agent, built for a configuration whose objects are named."""
    chosen = agent_of(agent)
    return pairs_of(chosen.services, config) + [_core(module, config) for module in chosen.cores]


def local_pairs(agent: str, config: Config, world: str = DEFAULT_WORLD) -> list[Pair]:
    """Everything that an in-process run needs: the source, the agent, who judges it. Raises SaccadeError for an agent
    that must be told a truth which the world does not know.

    Limits torch's threads as the launcher does for its processes: else the bytes would not be those of the bus.
    """
    limit_torch()
    chosen = world_of(world)
    source, *judges = pairs_of((chosen.source, *chosen.judges), config)
    agents = agent_pairs(agent, config)
    if TRUTH not in source[0].outputs and any(TRUTH in service.inputs for service, _ in agents):
        raise SaccadeError(f"agent {agent!r} must be told the truth, which the world {world!r} does not know: choose "
                           "another agent")
    return [source, *agents, *judges]


def agent_processes(agent: str, world: str = DEFAULT_WORLD, *, view: bool = False) -> tuple[Process, ...]:
    """The processes of a run on the bus, the router first and the source second; with `view` the viewer last. Raises
    SaccadeError for an agent that has none of its own."""
    chosen, place = agent_of(agent), world_of(world)
    if chosen.cores:
        raise SaccadeError(f"agent {agent!r} runs within one process only: add `--bus local`")
    names = (ROUTER, place.source, *chosen.services, *place.judges, RECORDER)
    return (*(Process(name, f"saccade.services.{name}") for name in names), *((VIEWER,) if view else ()))


def weight_hashes(agent: str, config: Config) -> dict[str, str]:
    """Hashes of the weights that an agent works with, by file; none for one that needs none.

    Raises SaccadeError where they are missing, damaged or lack one of the run's objects.
    """
    if not agent_of(agent).weights:
        return {}
    from saccade.shared.model.weights import Weights

    weights = Weights(config.weights)
    weights.cards_of(config.scene.names or ())
    return dict(sorted(weights.hashes.items()))


def service_of(name: str, config: Config | None = None) -> Service:
    """The declaration of a service of a run, or of ours."""
    return load(name, config or Config()).service


def pairs_of(names: Sequence[str], config: Config) -> list[Pair]:
    """Declarations and cores of services, built for a configuration whose objects are named. Raises SaccadeError for a
    module from outside that is none."""
    limit_torch()
    modules = [load(name, config) for name in names]
    return [(module.service, module.build(config)) for module in modules]


def require_services(agent: str, config: Config, world: str) -> None:
    """Raises SaccadeError for a module from outside that is none: before any process starts."""
    for name in (world_of(world).source, *agent_of(agent).services):
        if getattr(config.services, "source" if name in SOURCES else name) is not None:
            load(name, config)


def _core(module_name: str, config: Config) -> Pair:
    module = import_module(module_name)
    return module.SERVICE, module.build(config)
