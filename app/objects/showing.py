"""`saccade objects list` and `show`."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from saccade.app.objects.learning import likeness
from saccade.app.objects.store import CARD, TURNTABLE
from saccade.app.run.display import say
from saccade.shared.config import learned_folder, set_folder
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable, told
from saccade.shared.model.weights import MANIFEST, OPEN, Weights
from saccade.shared.render.objects import load_mesh, names_of

ALIKE = 5  # objects that are told to look most alike


def list_set(objects: str, console: Console) -> None:
    """Prints the objects of a set: their sizes, and whether they are learnt. Raises SaccadeError if there are none."""
    learnt = _learnt(objects)
    table = Table("object", "size (cm)", "faces", "learnt")
    for name in names_of(objects):
        mesh = load_mesh(objects, name)
        table.add_row(Text(name), _size(mesh.size_m), str(len(mesh.faces)), "yes" if name in learnt else "no")
    console.print(table)


def show_object(objects: str, name: str, console: Console) -> None:
    """Prints what is known of an object, and which others look most like it. Raises SaccadeError if it is not
    there."""
    if name not in names_of(objects):
        raise SaccadeError(f"object {told(name)} is not in {objects!r}: it holds {', '.join(names_of(objects))}")
    folder = set_folder(objects)
    if folder is not None and (folder / name / CARD).is_file():
        text = (folder / name / CARD).read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            console.print(Text(printable(line, LINE_LIMIT)), soft_wrap=True)
        say(console, f"its picture is {folder / name / TURNTABLE}")
    else:
        say(console, f"{name}: {_size(load_mesh(objects, name).size_m)} cm")
    if name not in _learnt(objects):
        say(console, "it is not learnt: `saccade objects learn`")
        return
    names, alike = likeness(objects)
    row = alike[names.index(name)]
    others = sorted(((float(row[k]), other) for k, other in enumerate(names) if other != name), reverse=True)[:ALIKE]
    if others:
        said = ", ".join(f"{other} ({value:.2f})" for value, other in others)
        say(console, f"most like it (1 is the same): {said}")


def _learnt(objects: str) -> tuple[str, ...]:
    folder = learned_folder(objects, OPEN)
    return Weights(folder).names if (folder / MANIFEST).is_file() else ()


def _size(size_m) -> str:
    return " x ".join(f"{100 * side:.1f}" for side in size_m)
