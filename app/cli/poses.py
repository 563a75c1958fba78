"""`saccade poses show`: what a file of a camera's poses holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from saccade.app.cli.options import Values
from saccade.shared.errors import LINE_LIMIT, printable

app = typer.Typer(no_args_is_help=True, help="Look at files that hold the poses of a camera.")


@app.callback()
def poses() -> None:
    """Look at files that hold the poses of a camera."""


@app.command()
def show(file: Annotated[Path, typer.Argument(metavar="FILE", help="File or folder with the poses of a camera.")], *,
         out: Annotated[Path | None, typer.Option(
             help="Draw the cameras and the table, from above and from the side.", metavar="PICTURE.png")] = None,
         scale: Annotated[float | None, typer.Option(
             help="Length in metres of the unit of the poses.", show_default="1")] = None,
         values: Values = None) -> None:
    """Say how a file of poses is understood: its format, number, times, extent and conventions."""
    from saccade.app.cli.texts import parse_value
    from saccade.app.look.pose_report import report
    from saccade.services.camera.poses import asked_of
    from saccade.services.camera.trajectories.reading import read_trajectory
    from saccade.shared.config import Config

    given = {} if scale is None else {"camera.poses_scale": scale}
    config = Config().with_values(given | dict(map(parse_value, values or ())))
    read = read_trajectory(file, asked_of(config.camera))
    for line in report(read):
        print(printable(line, LINE_LIMIT))
    if out is not None:
        from saccade.app.look.pose_picture import draw_poses

        draw_poses(read, out)
        print(f"written to {out}")
