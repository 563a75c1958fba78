"""`saccade log <command>`: logs of runs looked at, checked, mended, cut and exported."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from saccade.app.cli.options import wide
from saccade.shared.errors import LINE_LIMIT, printable

EXIT_INCOMPLETE = 1

app = typer.Typer(no_args_is_help=True, help="Inspect, check, recover, cut and export the logs of runs.")

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its log.")]
Out = Annotated[Path, typer.Option(help="File of the new log.")]


@app.command()
def info(run: Run) -> None:
    """Show where a log comes from and what is in it: episodes, messages, rates, sizes and gaps."""
    from rich.console import Console

    from saccade.app.log.info import gather, lines
    from saccade.app.log.source import log_of

    told = gather(log_of(run))
    for line in lines(told):
        print(line)
    wide(Console()).print(told.keys.table(told.reader.world), markup=False)


@app.command()
def check(run: Run) -> None:
    """Check whether a log is complete. The exit code is 0 if nothing is missing, else 1."""
    from saccade.app.log.check import missing
    from saccade.app.log.source import log_of

    report = missing(log_of(run))
    _tell(report.lines())
    if not report.complete:
        raise typer.Exit(EXIT_INCOMPLETE)
    print(f"complete: {report.messages} messages")


@app.command()
def recover(run: Run, out: Out) -> None:
    """Make a good log of a cut or damaged one, and report what was lost."""
    from saccade.app.log.check import missing
    from saccade.app.log.recover import recover as recover_log
    from saccade.app.log.source import log_of

    report = recover_log(log_of(run), out)
    lost = [*report.lines(), *missing(out).lines()]
    print(f"{report.messages} messages written to {out}; " + ("it lacks:" if lost else "nothing is missing"))
    _tell(lost)


@app.command()
def cut(run: Run, out: Out,
        episode: Annotated[int | None, typer.Option(min=0, help="Episode.", show_default="the last")] = None,
        start: Annotated[int, typer.Option(min=0, help="First step.")] = 0,
        end: Annotated[int | None, typer.Option(min=0, help="Last step.", show_default="the last")] = None) -> None:
    """Copy some steps of an episode into a log of their own."""
    from saccade.app.log.check import missing
    from saccade.app.log.cut import cut as cut_log
    from saccade.app.log.source import log_of

    kept = cut_log(log_of(run), out, episode=episode, start=start, end=end)
    print(f"{kept} written to {out}")
    _tell(missing(out).lines())


def _tell(lines: Iterable[str]) -> None:
    """Prints lines in which there may be names from a log."""
    for line in lines:
        print(printable(line, LINE_LIMIT))


@app.command()
def export(run: Run,
           out: Annotated[Path, typer.Option(help="The new file, or the new folder with --tables.")],
           tables: Annotated[bool, typer.Option(
               "--tables", help="Write one Parquet table for each topic instead of MCAP.")] = False) -> None:
    """Convert a log for other tools: to MCAP that Foxglove and Rerun show, or to tables."""
    from saccade.app.log.export import export_foxglove, export_tables
    from saccade.app.log.source import log_of

    if tables:
        print(f"{len(export_tables(log_of(run), out))} tables written to {out}")
    else:
        print(f"{sum(export_foxglove(log_of(run), out).values())} messages written to {out}")
