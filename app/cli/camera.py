"""`saccade board` and `saccade calibrate`: what a real camera needs to know where it is, and how its lens sees."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer()


@app.command()
def board(*, out: Annotated[Path, typer.Option(help="The sheet; its description is written beside it, as .json.",
                                               metavar="BOARD.pdf")] = Path("board.pdf"),
          size: Annotated[Literal["a4", "letter", "a3"], typer.Option(help="Size of the paper.")] = "a4",
          middle: Annotated[Literal["full", "free"], typer.Option(
              help="Squares everywhere, for objects beside the sheet, or a free middle where objects stand.")] = "full",
          square_mm: Annotated[float | None, typer.Option(
              min=5, max=200, help="Side of a square in millimetres.", show_default="25; 35 on A3")] = None,
          number: Annotated[int, typer.Option(
              min=1, max=16, help="Number of the sheet, if several are used together.")] = 1,
          measured_mm: Annotated[float | None, typer.Option(
              min=1, help="Length of the ruler on your print, if it is not what it says.")] = None) -> None:
    """Make a board to print: it tells Saccade where the camera is, and calibrates it."""
    from saccade.app.camera.sheet import PAPERS, as_printed, board_for, write_sheet

    paper = PAPERS[size]
    made = board_for(paper, square_mm and square_mm / 1e3, free_middle=middle == "free", number=number)
    measured_m = measured_mm and measured_mm / 1e3
    printed = as_printed(made, paper, measured_m)
    told = write_sheet(out, made, paper, measured_m)
    columns, rows = made.squares
    print(f"{out}: {columns}x{rows} squares of {1e3 * made.square_m:g} mm on {size}; print it at 100% and measure the "
          f"ruler: {1e3 * paper.ruler_m:.0f} mm")
    print(f"{told}: its description, with squares of {1e3 * printed.square_m:.4g} mm")


@app.command()
def calibrate(source: Annotated[str, typer.Argument(
                  metavar="VIDEO|FOLDER", help="Images of the board from many sides, all from the camera.")], *,
              board: Annotated[Path, typer.Option(help="Description of the board that `saccade board` wrote.",
                                                  metavar="BOARD.json")],
              model: Annotated[Literal["pinhole", "fisheye"], typer.Option(
                  help="Model of the lens; fisheye for fields of view beyond about 110 degrees.")] = "pinhole",
              out: Annotated[Path | None, typer.Option(
                  help="File for the calibration. The picture of its residuals is put beside it, as .png.",
                  metavar="CAMERA.toml", show_default="camera.toml")] = None,
              name: Annotated[str | None, typer.Option(
                  help="Keep it under this name instead; `--calibration NAME` finds it.")] = None) -> None:
    """Find the intrinsics and the distortion of a camera from views of a board."""
    from rich.console import Console

    from saccade.app.camera.calibrate import calibrate as find
    from saccade.services.camera.calibration import kept_as
    from saccade.shared.errors import SaccadeError

    if out is not None and name is not None:
        raise SaccadeError("--out and --name both say where the calibration goes: give one of them")
    target = kept_as(name) if name is not None else out or Path("camera.toml")
    for line in find(source, board, model, target, Console(stderr=True)):
        print(line)
    print(f"use it with `saccade run --world camera --calibration {name or target}`")
