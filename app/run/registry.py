"""Lists by name which services make an agent and a world. The processes of a run, and the cores of an in-process run,
are derived from this list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from saccade.app.run.launch import JUDGE, RECORDER
from saccade.app.run.supervisor import GUIDE, ROS, VIEWER, Process
from saccade.app.run.threads import limit_torch
from saccade.shared.bus.topics import TRUTH
from saccade.shared.config import BUILT_IN_SETS, FLAT_LOOK, Config
from saccade.shared.config import load as load_config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.modules import chosen_module, load
from saccade.shared.loop.service import Core, Service

Pair = tuple[Service, Core]

ROUTER = "router"


@dataclass(frozen=True)
class World:
    """Where images come from and where actions may go: the service `source`. `judges` are the services that compare
    with its truth, if it has one. A world that is `live` waits for nobody."""

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
    """What an agent consists of: `services` are processes of their own, `cores` are modules that run only within one
    process. `preset` is the configuration that makes it this agent: other networks, other modules in the services'
    places. `knows` says what it works with."""

    services: tuple[str, ...] = ()
    cores: tuple[str, ...] = ()
    preset: str | None = None
    weights: bool = True  # whether it needs trained weights
    knows: str = "RGB, camera pose"


DEFAULT_AGENT, OPEN = "sceneccn", "open"
ALL_THREE = ("perception", "belief", "planner")
AGENTS = {
    "sceneccn": Agent(ALL_THREE),
    "paper": Agent(ALL_THREE, preset="paper"),
    "open": Agent(ALL_THREE, preset="open"),
    "posecnn": Agent(("perception", "planner"), preset="posecnn", knows="RGB, depth, camera pose"),
    "posecnn-infogain": Agent(ALL_THREE, preset="posecnn-infogain", knows="RGB, depth, camera pose"),
    "render-and-compare": Agent(ALL_THREE, preset="render-and-compare", knows="RGB, camera pose, meshes"),
    "lexa": Agent(("planner",), preset="lexa", knows="RGB"),
    "random-walk": Agent(("planner",), preset="random-walk", weights=False, knows="nothing"),
    "still": Agent(("planner",), preset="still", weights=False, knows="nothing"),
    "oracle": Agent(cores=("saccade.services.planner.oracle",), weights=False, knows="the goal's pose"),
}


def agent_of(name: str) -> Agent:
    """Returns the agent of that name. Raises SaccadeError if the name is unknown."""
    if name not in AGENTS:
        raise SaccadeError(f"agent {name!r} is unknown: choose from {', '.join(AGENTS)}")
    return AGENTS[name]


def configuration(path: Path | None, keys: Mapping[str, Any], agent: str | None = None, *,
                  lying: bool = False) -> tuple[Config, str]:
    """The configuration and the name of its agent: the agent's preset, over it the file, over it the dotted keys.

    Without the name of an agent it is `sceneccn`, or `open` where there is a reason for it (`reason_for_open`). Raises
    SaccadeError if the agent is unknown, or if the file, a key or a value is wrong.
    """
    if agent is None:
        agent = DEFAULT_AGENT if reason_for_open(load_config(path).with_values(dict(keys)), lying) is None else OPEN
    return load_config(path, agent_of(agent).preset).with_values(dict(keys)), agent


def reason_for_open(config: Config, lying: bool = False) -> str | None:
    """Why the agent `open` is the one for this configuration. None if `sceneccn` is, which knows the built-in objects
    in flat light, or the given weights. `lying` says that objects may lie, as in some suites."""
    if config.perception.weights is not None:
        return None
    if config.scene.objects not in BUILT_IN_SETS:
        return "it is the one that knows objects of your own"
    if config.camera.source is not None or config.scene.goal_image is not None:
        return "it is the one for photographs"
    if (config.simulator.look, config.simulator.goal_look or FLAT_LOOK) != (FLAT_LOOK, FLAT_LOOK):
        return "it is the one for any light"
    if lying or (config.scene.file is not None and _lie_in(config.scene.file)):
        return "it is the one for objects that lie or fall"
    return None


def _lie_in(scenes: Path) -> bool:
    """Whether objects lie, or will, in a scenes file. Raises SaccadeError if it is missing or damaged."""
    from saccade.services.simulator.scenes import load_scenes  # here, because most runs have no such file

    return any(scene.lying for scene in load_scenes(scenes))


def world_of(name: str) -> World:
    """Returns the world of that name. Raises SaccadeError if the name is unknown."""
    if name not in WORLDS:
        raise SaccadeError(f"world {name!r} is unknown: choose from {', '.join(WORLDS)}")
    return WORLDS[name]


def agent_pairs(agent: str, config: Config) -> list[Pair]:
    """Builds the declarations and cores of an agent. The configuration must name the objects. Raises SaccadeError if
    the agent is unknown."""
    chosen = agent_of(agent)
    return pairs_of(chosen.services, config) + [_core(module, config) for module in chosen.cores]


def local_pairs(agent: str, config: Config, world: str = DEFAULT_WORLD) -> list[Pair]:
    """Builds everything that an in-process run needs: the source, the agent and its judges. Raises SaccadeError if the
    agent must be told the truth, and the world does not know it.

    PyTorch gets as many threads as in the launcher's processes. With another number the bytes would differ from those
    on the bus.
    """
    limit_torch()
    chosen = world_of(world)
    source, *judges = pairs_of((chosen.source, *chosen.judges), config)
    agents = agent_pairs(agent, config)
    if TRUTH not in source[0].outputs and any(TRUTH in service.inputs for service, _ in agents):
        raise SaccadeError(f"agent {agent!r} must be told the truth, which the world {world!r} does not know: choose "
                           "another agent")
    return [source, *agents, *judges]


def agent_processes(agent: str, world: str = DEFAULT_WORLD, *, view: bool = False,
                    ros: bool = False, guide: bool = False) -> tuple[Process, ...]:
    """Returns the processes of a run on the bus: the router first, the source second, and the onlookers last: with
    `view` the viewer, with `guide` the page that guides a hand, and with `ros` the bridge to ROS 2. Raises SaccadeError
    if the agent runs only within one process."""
    chosen, place = agent_of(agent), world_of(world)
    if chosen.cores:
        raise SaccadeError(f"agent {agent!r} runs within one process only: add `--bus local`, or bus='local' in Python")
    names = (ROUTER, place.source, *chosen.services, *place.judges, RECORDER)
    onlookers = (process for process, wanted in ((VIEWER, view), (GUIDE, guide), (ROS, ros)) if wanted)
    return (*(Process(name, f"saccade.services.{name}") for name in names), *onlookers)


def weight_hashes(agent: str, config: Config) -> dict[str, str]:
    """Returns the hashes of the weights that an agent works with, by file. It is empty for an agent that needs no
    weights.

    Raises SaccadeError if the weights are missing or damaged, or if they lack one of the run's objects.
    """
    if not agent_of(agent).weights:
        return {}
    from saccade.shared.model.weights import weights_in_use

    weights = weights_in_use(config)
    weights.cards_of(config.scene.names or ())
    shared = weights.networks.hashes if "networks" in weights.manifest else {}
    return dict(sorted(weights.hashes.items())) | {f"shared/{name}": shared[name] for name in sorted(shared)}


def service_of(name: str, config: Config | None = None) -> Service:
    """Returns the declaration of a service: the one that the configuration puts in its place, else Saccade's own."""
    return load(name, config or Config()).service


def pairs_of(names: Sequence[str], config: Config) -> list[Pair]:
    """Builds the declarations and cores of services. The configuration must name the objects. Raises SaccadeError if a
    user's module is not a service."""
    limit_torch()
    modules = [load(name, config) for name in names]
    return [(module.service, module.build(config)) for module in modules]


def require_services(agent: str, config: Config, world: str) -> None:
    """Checks the user's modules before any process starts. Raises SaccadeError if one of them is not a service."""
    for name in (world_of(world).source, *agent_of(agent).services):
        if chosen_module(name, config) is not None:
            load(name, config)


def _core(module_name: str, config: Config) -> Pair:
    module = import_module(module_name)
    return module.SERVICE, module.build(config)
