"""`saccade replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from saccade.app.cli.options import Values, wide
from saccade.app.cli.texts import parse_value

app = typer.Typer()


@app.command()
def replay(logs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or their logs.")], *,
           into: Annotated[str, typer.Option(
               metavar="NAMES", help="Services that the recorded inputs are played to: "
                                     "perception,belief,planner,evaluator.")],
           check: Annotated[bool, typer.Option(
               "--check", help="End with exit code 1 if anything differs from the recording.")] = False,
           bus: Annotated[Literal["zenoh", "local"], typer.Option(
               help="Run each service as a process on a Zenoh bus, or all within this process.")] = "zenoh",
           rate: Annotated[str, typer.Option(help="Speed relative to the recording, from 0.1 to 100, or max.")] = "max",
           start: Annotated[str | None, typer.Option(help="First step, or a time such as 2.5s.")] = None,
           end: Annotated[str | None, typer.Option(help="Last step, or a time such as 9s.")] = None,
           episode: Annotated[int | None, typer.Option(min=0, help="Play only this episode.")] = None,
           topics: Annotated[str | None, typer.Option(metavar="NAMES", help="Play only these of the inputs.")] = None,
           loop: Annotated[int, typer.Option(min=1, help="How many times the log is played.")] = 1,
           step: Annotated[bool, typer.Option("--step", help="Play one message for each key press.")] = False,
           perception: Annotated[Path | None, typer.Option(
               help="Use other weights: a folder, or its name in weights/. A table and a picture then show how far "
                    "everything moved.")] = None,
           out: Annotated[Path | None, typer.Option(
               help="New folder of the replay.", show_default="replays/<time>")] = None,
           values: Values = None) -> None:
    """Play recorded inputs into the services as they are now, and compare what they say with the recording.

    The space bar pauses and continues, q ends the replay.
    """
    from rich.console import Console

    from saccade.app.replay.report import replay_all, replays_of

    replays = replays_of(logs, into=into, rate=rate, start=start, end=end, episode=episode, topics=topics, step=step,
                         perception=perception, values=dict(parse_value(text) for text in values or ()))
    swapped = bool(perception or values)
    equal = replay_all(replays, bus=bus, out=out, swapped=swapped, loops=loop, console=wide(Console()))
    raise typer.Exit(int(check and not equal))
