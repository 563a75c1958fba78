"""`saccade replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from saccade.app.cli.options import Values, parse_value, wide

app = typer.Typer()


@app.command()
def replay(logs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="folders of runs, or their logs")], *,
           into: Annotated[str, typer.Option(metavar="NAMES", help="services: perception,belief,planner,evaluator")],
           check: Annotated[bool, typer.Option("--check", help="exit code 1 if anything is not as recorded")] = False,
           bus: Annotated[Literal["zenoh", "local"], typer.Option(
               help="services as processes on Zenoh, or all within this one")] = "zenoh",
           rate: Annotated[str, typer.Option(help="times as fast as recorded, 0.1 to 100, or max")] = "max",
           start: Annotated[str | None, typer.Option(help="first step, or a time such as 2.5s")] = None,
           end: Annotated[str | None, typer.Option(help="last step, or a time such as 9s")] = None,
           episode: Annotated[int | None, typer.Option(min=0, help="only this one")] = None,
           topics: Annotated[str | None, typer.Option(metavar="NAMES", help="only these of the inputs")] = None,
           loop: Annotated[int, typer.Option(min=1, help="so many times")] = 1,
           step: Annotated[bool, typer.Option("--step", help="one message for each key press")] = False,
           perception: Annotated[Path | None, typer.Option(
               help="other weights: a folder, or its name in weights/; tells what moved")] = None,
           out: Annotated[Path | None, typer.Option(help="folder of the replay", show_default="replays/<time>")] = None,
           values: Values = None) -> None:
    """Play recorded inputs into services as they are now, log what they say, compare it with the recording.

    Space pauses and goes on, q ends.
    """
    from rich.console import Console

    from saccade.app.replay.report import replay_all, replays_of

    replays = replays_of(logs, into=into, rate=rate, start=start, end=end, episode=episode, topics=topics, step=step,
                         perception=perception, values=dict(parse_value(text) for text in values or ()))
    swapped = bool(perception or values)
    equal = replay_all(replays, bus=bus, out=out, swapped=swapped, loops=loop, console=wide(Console()))
    raise typer.Exit(int(check and not equal))
