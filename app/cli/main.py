"""The front door: `saccade <command>`. Commands load what they need when they are called."""

from __future__ import annotations

import errno
import signal
import sys
from typing import Annotated

import typer

from saccade.app.cli import bench, camera, log, look, objects, poses, replay, run, train
from saccade.app.cli.front import FrontDoor, command_of
from saccade.app.run.threads import prefer_one_thread
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable
from saccade.shared.files import remedy

EXIT_ERROR, EXIT_INTERRUPTED = 2, 130
MENDABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ENAMETOOLONG,
            errno.EMFILE, errno.ENFILE)

app = typer.Typer(name="saccade", cls=FrontDoor, no_args_is_help=True, add_completion=False,
                  pretty_exceptions_enable=False)


def _tell_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        from saccade.shared.log.provenance import commit

        print(f"saccade {version('saccade')} (commit {commit()})")
        raise typer.Exit


@app.callback()
def front_door(version: Annotated[bool, typer.Option(
        "--version", callback=_tell_version, is_eager=True, help="Print the version and the commit, and end.")] = False,
        ) -> None:
    """An active-vision agent: it looks, believes and moves until it sees the goal image."""


for commands in (run, replay, bench, train, look, camera):
    app.add_typer(commands.app)
app.add_typer(log.app, name="log")
app.add_typer(poses.app, name="poses")
app.add_typer(objects.app, name="objects")


@app.command()
def doctor() -> None:
    """Check what works on this machine, what is missing, and how to get it."""
    from saccade.app.doctor import examine

    raise typer.Exit(examine())


def main() -> None:
    """The console script: what the user can mend is one line and exit code 2, Ctrl-C one line and 130."""
    prefer_one_thread()
    try:
        command_of(app)(prog_name="saccade")
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)
    except OSError as error:  # of a place or a machine that has no more; others are faults of ours
        if error.errno not in MENDABLE:
            raise
        where = f"{error.filename}: " if error.filename else ""
        told = printable(f"{where}{error.strerror}: {remedy(error)}", LINE_LIMIT)
        print(f"saccade: {told}", file=sys.stderr)
        sys.exit(EXIT_ERROR)
    except SystemExit as error:
        if error.code == EXIT_INTERRUPTED:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # once more would break into the interpreter's end
            reason = getattr(error.__context__, "__cause__", None)
            print(f"saccade: interrupted{f': {printable(str(reason), LINE_LIMIT)}' if str(reason or '') else ''}",
                  file=sys.stderr)
        raise


if __name__ == "__main__":
    main()
