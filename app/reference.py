"""`python -m saccade.app.reference docs` writes the reference pages of the guide, from the code that they describe.

The page about the bus comes from the list of topics and from the messages. The page about the configuration comes from
its sections, and the page about the command line from the commands. The page about the agent's own constants comes from
their comments and from the results of `benchmarks/constants.py`.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import textwrap
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel
from typer.main import get_command

from saccade.app.constants import constants as all_constants
from saccade.app.run.registry import AGENTS, WORLDS, service_of
from saccade.shared.bus.messages import ArraySpec, Message, field_types, items_of
from saccade.shared.bus.topics import TOPICS, Topic
from saccade.shared.config import PACKAGE, Config

MEASURED = PACKAGE / "results" / "benchmarks" / "constants.json"


def pages() -> dict[str, str]:
    """Returns the text of every page, by its file name in the guide's folder."""
    return {"wire.md": wire(), "reference/configuration.md": configuration(), "reference/cli.md": command_line(),
            "reference/constants.md": constants()}


# --- the bus

WIRE_TEXT = """
Every message is a publication on a Zenoh key `saccade/<world>/<topic>`, with `/<object>` or `/<service>` where a topic
has parts. The payload is a MessagePack map with the fields below, and with `type` (the message's name) and `version`
before them. An array is MessagePack extension type 1: MessagePack `[dtype, shape]`, followed by the numbers,
little-endian and row by row. Units are SI, angles are radians, the world's z axis points up and the table's top is at
z = 0; `a_from_b` maps coordinates in b to coordinates in a. `examples/listen.py` reads frames and beliefs with a Zenoh
client and MessagePack alone.
"""


def wire() -> str:
    """Returns the page about the bus: every key and every field."""
    lines = ["# Topics and messages", "", _flat(WIRE_TEXT), "", "## Topics", "",
             "A latched topic has one message an episode, which holds for every later step.", ""]
    lines += _table(("topic", "key", "message", "latched", "published by", "heard by"), (
        (f"`{topic.name}`", f"`{topic.key('<world>', '<part>')}`", _link(topic.type), "yes" if topic.latched else "",
         ", ".join(_who(topic, "outputs")), ", ".join(_who(topic, "inputs"))) for topic in TOPICS.values()))
    lines += ["", "## Fields of every message", "", *_fields(Message, set())]
    common = set(field_types(Message))
    for message in dict.fromkeys(topic.type for topic in TOPICS.values()):
        lines += ["", f"## {message.__name__}", "", f"Version {message.VERSION}. {_flat(message.__doc__)}", "",
                  *_fields(message, common)]
    return "\n".join(lines) + "\n"


def _link(message: type[Message]) -> str:
    return f"[{message.__name__}](#{message.__name__.lower()})"


def _who(topic: Topic, side: str) -> Iterator[str]:
    """Yields the services that declare the topic. Every service publishes its status. The recorder reads every topic
    and is not named."""
    if topic.name == "status":
        yield {"outputs": "every service", "inputs": "launcher, viewer"}[side]
        return
    services = [*(world.source for world in WORLDS.values()), *AGENTS["sceneccn"].services,
                *dict.fromkeys(judge for world in WORLDS.values() for judge in world.judges)]
    for name in services:
        if topic in getattr(service_of(name), side):
            yield name


def _fields(message: type[Message], without: set[str]) -> list[str]:
    told = attribute_docstrings(message)
    return _table(("field", "type", ""), ((f"`{name}`", _kind(kind), told.get(name, ""))
                                          for name, kind in field_types(message).items() if name not in without))


def _kind(kind: Any) -> str:
    """The type of a field in words."""
    options = [option for option in get_args(kind) if option is not type(None)]
    if get_origin(kind) is not Annotated and type(None) in get_args(kind):
        return f"{_kind(options[0])}, or nil"
    if get_origin(kind) is Annotated:
        spec: ArraySpec = get_args(kind)[1]
        return f"array {spec.dtype} [{', '.join(str(n) for n in spec.shape)}]"
    if (item_type := items_of(kind)) is not None:
        return f"list of maps as [{item_type.__name__}](#{item_type.__name__.lower()})"
    return {str: "text", int: "integer", float: "number", bool: "true or false"}.get(kind, "list of texts")


# --- the configuration

CONFIGURATION_TEXT = """
A configuration file is TOML or JSON (`--config FILE`). Options of the command line override the file, and
`--set KEY=VALUE` overrides both, for example `--set planner.step_m=0.03`. An unknown key is an error. Every run saves
its whole configuration as `config.json`.
"""


def configuration() -> str:
    """Returns the page about the configuration: every key, section by section."""
    lines = ["# Configuration", "", _flat(CONFIGURATION_TEXT), "",
             "## Keys without a section", "", *_keys(Config, "")]
    for name, field in Config.model_fields.items():
        section = field.annotation
        if inspect.isclass(section) and issubclass(section, BaseModel):
            lines += ["", f"## {name}", "", _flat(section.__doc__), "", *_keys(section, f"{name}.")]
    return "\n".join(lines) + "\n"


def _keys(section: type[BaseModel], prefix: str) -> list[str]:
    return _table(("key", "default", ""), (
        (f"`{prefix}{name}`", f"`{json.dumps(field.default, default=str)}`", _flat(field.description))
        for name, field in section.model_fields.items()
        if not (inspect.isclass(field.annotation) and issubclass(field.annotation, BaseModel))))


# --- the command line

def command_line() -> str:
    """Returns the page about the command line: every command with its arguments and options."""
    from saccade.app.cli.main import app

    lines = ["# Command line", "", "`saccade COMMAND --help` shows the same."]
    for words, command in _commands(get_command(app), ()):
        lines += ["", f"## saccade {' '.join(words)}", "", _flat(command.help), ""]
        rows = [(_name(parameter), getattr(parameter, "help", None) or "", _default(parameter))
                for parameter in command.params if parameter.name != "help"]
        lines += _table(("", "", "default"), rows) if rows else ["It has no options."]
    return "\n".join(lines) + "\n"


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yields every command that has no subcommands, with the words that call it."""
    if not hasattr(command, "commands"):
        yield words, command
        return
    for name, inner in sorted(command.commands.items()):
        yield from _commands(inner, (*words, name))


def _name(parameter: Any) -> str:
    from saccade.app.cli.front import word_of

    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    value = word_of(parameter).replace("|", "\\|")
    return f"`{' '.join([', '.join([*parameter.opts, *parameter.secondary_opts]), value]).strip()}`"


def _default(parameter: Any) -> str:
    shown = getattr(parameter, "show_default", None)
    if isinstance(shown, str):
        return shown
    return "" if parameter.default in (None, False) or callable(parameter.default) else f"`{parameter.default}`"


# --- the agent's own constants

CONSTANTS_TEXT = """
Belief and planner hold numbers that neither the paper nor a measurement gives. For each of them, and for each number of
their configuration, the table says where it is from, how many of the 100 development scenes (YCB) the agent reaches
with half and with twice the value, and how many more steps it takes (mean ± standard error of the difference; negative
is fewer). Probabilities are doubled to 0.99 at most. `python -m saccade.benchmarks.constants` measured it.
"""


def constants() -> str:
    """Returns the page about the agent's own constants: where each comes from, and what happens on the development
    scenes at half and at twice its value."""
    state = json.loads(MEASURED.read_text()) if MEASURED.is_file() else {}
    lines = ["# The agent's own constants", "", _flat(CONSTANTS_TEXT), ""]
    if default := state.get("default"):
        steps = [record["steps"] for record in default]
        lines += [f"As they are, the agent reaches {sum(record['success'] for record in default)} of {len(default)} "
                  f"scenes, in {sum(steps) / len(steps):.2f} steps in the mean.", ""]
    measured = state.get("constants", {})
    rows = []
    for constant in all_constants():
        entry = measured.get(constant.label, {})
        changed = entry.get("value") not in (None, constant.value)
        effects = ["", ""] if changed else [_effect(entry.get(side)) for side in ("half", "twice")]
        rows.append((f"`{constant.label}`", f"{constant.value:g}", _flat(constant.comment), *effects))
    return "\n".join([*lines, *_table(("constant", "value", "", "half", "twice"), rows)]) + "\n"


def _effect(told: dict[str, Any] | None) -> str:
    if told is None:
        return ""
    return f"{told['reached']} reached, {told['more_steps']:+.2f} ± {told['more_steps_error']:.2f} steps"


# --- Markdown and source

def attribute_docstrings(owner: type) -> dict[str, str]:
    """Returns the text below each attribute of a class, including the attributes of its base classes."""
    told: dict[str, str] = {}
    for base in reversed(owner.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        statements = getattr(body, "body", [])
        for statement, after in pairwise(statements):
            if (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)
                    and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
                told[statement.target.id] = _flat(str(after.value.value))
    return told


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    return [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *(f"| {' | '.join(row)} |" for row in rows)]


def _flat(text: str | None) -> str:
    return " ".join((text or "").split())


def main(folder: Path) -> None:
    """Writes all pages into `folder`."""
    (folder / "reference").mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / name).write_text(text)
        print(f"written to {folder / name}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
