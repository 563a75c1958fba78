"""`saccade train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from saccade.app.cli.options import Names, Objects, Seed, WeightsFolder
from saccade.app.cli.texts import parse_value, split_names

app = typer.Typer()


@app.command()
def train(*, objects: Objects = None, names: Names = None,
          out: Annotated[Path | None, typer.Option(
              help="Folder of the training run.", show_default="training_runs/<set>")] = None,
          steps_ccn: Annotated[int | None, typer.Option(
              min=1, help="Training steps of each object's networks.")] = None,
          steps_extraction: Annotated[int | None, typer.Option(
              min=1, help="Training steps of the extraction network.")] = None,
          views: Annotated[int | None, typer.Option(
              min=20, max=5000, help="How many views of each object are rendered.")] = None,
          seed: Seed = None, jobs: Annotated[int, typer.Option(
              min=1, help="How many networks are trained at a time.")] = 1,
          device: Annotated[Literal["auto", "cpu", "cuda"] | None, typer.Option(
              help="Where to compute: on a GPU if there is one, or always on the named device.",
              show_default="auto")] = None,
          architecture: Annotated[Literal["default", "paper", "posecnn", "lexa", "open"], typer.Option(
              help="Saccade's networks, those of the paper's tables, PoseCNN, LEXA, or networks that know objects by "
                   "their views alone. Others than Saccade's go to folders named <set>-<architecture>.")] = "default",
          weights: WeightsFolder = None, values: Annotated[list[str] | None, typer.Option(
              "--set", metavar="KEY=VALUE", help="Set a training setting, such as batch_ccn=64. The guide's page "
                                                 "'Train networks' names the most important ones.")] = None) -> None:
    """Train the networks of an object set. The same command continues after an interruption."""
    from rich.console import Console

    from saccade.shared.config import SceneConfig, learned_folder
    from saccade.shared.render.objects import names_in_use
    from saccade.training.run import export
    from saccade.training.run import train as run_training
    from saccade.training.settings import settings_from

    object_set = SceneConfig(objects=objects or "pantry").objects
    given = {"seed": seed, "steps_ccn": steps_ccn, "steps_extraction": steps_extraction, "views": views,
             "device": device, "architecture": architecture}
    chosen = names_in_use(SceneConfig(objects=object_set, names=split_names(names)))
    settings = settings_from({"objects": object_set, "names": chosen}
                             | {k: v for k, v in given.items() if v is not None}
                             | dict(parse_value(text) for text in values or ()))
    name = Path(object_set).name + ("" if architecture == "default" else f"-{architecture}")
    folder, target = out or Path("training_runs") / name, weights or learned_folder(object_set, architecture)
    run_training(folder, settings, jobs=jobs, console=Console())
    export(folder, target)
    print(f"weights written to {target}")
