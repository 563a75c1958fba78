"""`saccade view`, `film` and `picture`, which show a run, `see`, which looks at photographs, and what listens on the
bus."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from saccade.app.cli.options import Names, Objects, WeightsFolder, wide
from saccade.shared.errors import SaccadeError
from saccade.shared.log.folder import PICTURE_NAME

app = typer.Typer()

RUN = typer.Argument(metavar="RUN", help="Folder of a run, or its log.")
Log = Annotated[Path, RUN]


@app.command()
def view(*, log: Annotated[Path | None, RUN] = None,
         live: Annotated[bool, typer.Option("--live", help="Show a run that is going on, instead of a log.")] = False,
         save: Annotated[Path | None, typer.Option(
             help="Write a recording for Rerun's own viewer instead of showing it.", metavar="RUN.rrd")] = None,
         truth: Annotated[bool, typer.Option(
             "--truth", help="Also show what only the simulator knows: the goal's camera, and the objects as "
                             "ghosts.")] = False,
         port: Annotated[int | None, typer.Option(
             min=1, max=65535, help="Port of the page.", show_default="9090 or the next that is free")] = None,
         open_page: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
         run: Annotated[Path | None, typer.Option(
             metavar="FOLDER", help="Folder of the run that is going "
                                    "on.", show_default="the newest in runs/ that answers")] = None,
         endpoint: Annotated[str | None, typer.Option(
             help="Address of a bus instead, such as tcp/127.0.0.1:7447.")] = None,
         weights: Annotated[Path | None, typer.Option(
             help="Weights of the networks that draw crops and "
                  "views.", show_default="the run's own, or weights/pantry")] = None) -> None:
    """Show a run in a browser: the table, beliefs, images, curves and decisions. Ctrl-C ends it."""
    from rich.console import Console

    if live == (log is not None):
        raise SaccadeError("give the log of a run, or --live for one that goes on")
    if live and save is not None:
        raise SaccadeError("--save is for a log: a run that goes on is being logged already")
    if not live and (run is not None or endpoint is not None):
        raise SaccadeError("--run and --endpoint are for a run that goes on: add --live, or leave them out")
    if save is not None:
        os.environ.setdefault("RUST_LOG", "off")  # what goes wrong in Rerun is said in one line of ours
    from saccade.app.look.view import view_live, view_log

    if log is None:
        view_live(endpoint=endpoint, run=run, truth=truth, port=port, open_page=open_page, weights=weights,
                  console=Console())
    else:
        view_log(log, save=save, truth=truth, port=port, open_page=open_page, weights=weights, console=Console())


@app.command()
def picture(log: Log,
            out: Annotated[Path | None, typer.Option(
                help="File of the picture.", show_default="picture.png beside the log")] = None,
            episode: Annotated[int | None, typer.Option(
                min=0, help="Episode.", show_default="the last")] = None) -> None:
    """Draw the picture of a run again, from its log."""
    from saccade.app.log.source import log_of
    from saccade.app.look.picture import draw

    file = log_of(log)
    target = out or file.with_name(PICTURE_NAME)
    draw(file, target, episode)
    print(f"written to {target}")


@app.command()
def film(log: Log, out: Annotated[Path, typer.Argument(help="File of the film: OUT.mp4 or OUT.gif.", metavar="OUT")], *,
         episode: Annotated[int | None, typer.Option(min=0, help="Episode.", show_default="the last")] = None,
         rate: Annotated[float, typer.Option(min=0.5, max=60, help="Steps per second.")] = 5.0) -> None:
    """Make a short film of an episode from its log."""
    from rich.console import Console

    from saccade.app.look.film import film as make_film

    make_film(log, out, episode=episode, rate_hz=rate, console=Console(stderr=True))
    print(f"written to {out}")


@app.command()
def see(photos: Annotated[list[Path], typer.Argument(metavar="PHOTO...", help="Photographs: PNG or JPEG.")], *,
        objects: Objects = None, names: Names = None,
        agent: Annotated[str | None, typer.Option(
            help="Whose networks look: open, sceneccn, paper or posecnn.",
            show_default="open, which was made for photographs; sceneccn for --weights")] = None,
        weights: WeightsFolder = None,
        intrinsics: Annotated[str | None, typer.Option(
            help="Intrinsics of the photographs in their own size, in pixels.", metavar="fx,fy,cx,cy",
            show_default="from their EXIF data")] = None,
        json_file: Annotated[Path | None, typer.Option(
            "--json", help="Write what is seen, with masks, as JSON.", metavar="FILE")] = None,
        out: Annotated[Path | None, typer.Option(
            help="Save a picture with outlines and names for each photograph.", metavar="FOLDER")] = None,
        map_file: Annotated[Path | None, typer.Option(
            "--map", help="Write a map of the objects and cameras, by the objects that photographs have in common.",
            metavar="FILE")] = None) -> None:
    """Say which objects are in photographs, where, how far, how sure, and how they are turned."""
    from rich.console import Console

    from saccade.app.cli.texts import configured, numbers, split_names
    from saccade.app.look.see import see as look_at
    from saccade.app.run.registry import OPEN

    given = numbers(intrinsics)
    if given is not None and len(given) != 4:
        raise SaccadeError(f"--intrinsics {intrinsics!r}: write fx,fy,cx,cy, such as 615,615,320,240")
    if agent is None and weights is None:
        agent = OPEN
    config, agent = configured(None, {"scene.objects": objects, "scene.names": split_names(names),
                                      "perception.weights": weights}, None, agent)
    if look_at(photos, config, agent=agent, intrinsics_px=given, json_file=json_file, out=out, console=wide(Console()),
               map_file=map_file):
        raise typer.Exit(2)  # each one was said


Key = Annotated[str, typer.Argument(
    metavar="KEY", help="Full key, topic, or topic/part. An asterisk stands for anything.")]
LogFile = Annotated[Path | None, typer.Option(
    help="Read a log, or the log in a run's folder, instead of a bus.", metavar="RUN")]
Count = Annotated[int | None, typer.Option(min=1, help="End after so many messages.")]
Endpoint = Annotated[str | None, typer.Option(help="Address of the bus, such as tcp/127.0.0.1:7447.")]
OfRun = Annotated[Path | None, typer.Option(
    metavar="FOLDER", help="Folder of a run that is going on, whose bus is "
                           "used.", show_default="the newest in runs/ that answers")]


@app.command()
def topics(*, world: Annotated[str | None, typer.Option(
               help="World, which is the second part of every key.", show_default="the run's, or table")] = None,
           log: LogFile = None,
           live: Annotated[bool, typer.Option(
               "--live", help="Show the keys of a run that is going on. Implied by --endpoint, --run and "
                              "--seconds.")] = False,
           seconds: Annotated[int | None, typer.Option(
               min=1, max=3600, help="How many seconds to listen.", show_default="2")] = None,
           endpoint: Endpoint = None, run: OfRun = None) -> None:
    """List the topics, keys and message types. For a live run or a log, also show how much comes on each key."""
    from rich.console import Console

    from saccade.app.look.topics import topics as list_topics

    list_topics(world=world, log=log, on_bus=live, seconds=seconds, endpoint=endpoint, run=run, console=wide(Console()))


@app.command()
def echo(key: Key, log: LogFile = None, count: Count = None, endpoint: Endpoint = None, run: OfRun = None) -> None:
    """Print messages, live or from a log. Ctrl-C ends it."""
    from saccade.app.look.echo import echo as print_messages

    print_messages(key, log=log, count=count, endpoint=endpoint, run=run)


@app.command()
def hz(key: Key, log: LogFile = None, count: Count = None, endpoint: Endpoint = None, run: OfRun = None) -> None:
    """Show how often and how evenly messages come, live or from a log. Ctrl-C ends it."""
    from saccade.app.look.hz import hz as show_rates

    show_rates(key, log=log, count=count, endpoint=endpoint, run=run)
