"""`saccade view`, `film` and `picture`: commands that show a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from shared.errors import SaccadeError

app = typer.Typer()

RUN = typer.Argument(metavar="RUN", help="folder of a run, or its log")
Log = Annotated[Path, RUN]


@app.command()
def view(*, log: Annotated[Path | None, RUN] = None,
         live: Annotated[bool, typer.Option("--live", help="a run that goes on, instead of a log")] = False,
         save: Annotated[Path | None, typer.Option(
             help="write a recording for Rerun's own viewer instead", metavar="RUN.rrd")] = None,
         truth: Annotated[bool, typer.Option(
             "--truth", help="also what the simulator alone knows: the goal's camera, objects as ghosts")] = False,
         port: Annotated[int | None, typer.Option(
             min=1, max=65535, help="of the page", show_default="9090 or the next that is free")] = None,
         open_page: Annotated[bool, typer.Option("--open", help="open it in this machine's browser")] = False,
         run: Annotated[Path | None, typer.Option(
             metavar="FOLDER", help="of a run that goes on", show_default="the newest in runs/ that answers")] = None,
         endpoint: Annotated[str | None, typer.Option(help="a bus instead, e.g. tcp/127.0.0.1:7447")] = None,
         weights: Annotated[Path | None, typer.Option(
             help="that draw crops and views", show_default="the run's own, or weights/pantry")] = None) -> None:
    """See it think: the table, beliefs, images and curves of a run in a browser; Ctrl-C ends it."""
    from rich.console import Console

    if live == (log is not None):
        raise SaccadeError("give the log of a run, or --live for one that goes on")
    if live and save is not None:
        raise SaccadeError("--save is for a log: a run that goes on is being logged already")
    if not live and (run is not None or endpoint is not None):
        raise SaccadeError("--run and --endpoint are for a run that goes on: add --live, or leave them out")
    from deploy.view import view_live, view_log

    if live:
        view_live(endpoint=endpoint, run=run, truth=truth, port=port, open_page=open_page, weights=weights,
                  console=Console())
    else:
        view_log(log, save=save, truth=truth, port=port, open_page=open_page, weights=weights, console=Console())


@app.command()
def picture(log: Log,
            out: Annotated[Path | None, typer.Option(help="file", show_default="picture.png beside the log")] = None,
            episode: Annotated[int | None, typer.Option(min=0, help="which", show_default="the last")] = None) -> None:
    """Draw the picture of a run from its log once more."""
    from deploy.logs.source import log_of
    from deploy.picture import draw
    from deploy.run import PICTURE_NAME

    file = log_of(log)
    target = out or file.with_name(PICTURE_NAME)
    draw(file, target, episode)
    print(f"written to {target}")


@app.command()
def film(log: Log, out: Annotated[Path, typer.Argument(help="OUT.mp4 or OUT.gif", metavar="OUT")], *,
         episode: Annotated[int | None, typer.Option(min=0, help="which one", show_default="the last")] = None,
         rate: Annotated[float, typer.Option(min=0.5, max=60, help="steps a second")] = 5.0) -> None:
    """Make a short film of an episode from its log: for a paper, a README."""
    from rich.console import Console

    from deploy.film import film as make_film

    make_film(log, out, episode=episode, rate_hz=rate, console=Console(stderr=True))
    print(f"written to {out}")
