"""`saccade objects list` and `show`."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from saccade.app.objects.cards import TURNTABLE, digest
from saccade.app.objects.learning import digests_of, likeness
from saccade.app.run.display import say
from saccade.shared.config import learned_folder, set_folder
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable, told
from saccade.shared.model.object_card import CARD
from saccade.shared.model.weights import OPEN, Weights
from saccade.shared.render.objects import load_mesh, names_of

ALIKE = 5  # objects that are told to look most alike


def list_set(objects: str, console: Console) -> None:
    """Prints the objects of a set: their sizes, and whether they are learnt. Raises SaccadeError if there are none."""
    table = Table("object", "size (cm)", "faces", "learnt")
    for name in names_of(objects):
        try:
            mesh = load_mesh(objects, name)
            table.add_row(Text(name), _size(mesh.size_m), str(len(mesh.faces)), _learnt(objects, name))
        except SaccadeError as error:
            table.add_row(Text(name), "", "", Text(f"damaged: {printable(str(error), LINE_LIMIT)}"))
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
    if (state := _learnt(objects, name)) != "yes":
        say(console, f"learnt: {state}; `saccade objects learn` does it")
        return
    names, alike = likeness(objects)
    row = alike[names.index(name)]
    others = sorted(((float(row[k]), other) for k, other in enumerate(names) if other != name), reverse=True)[:ALIKE]
    if others:
        said = ", ".join(f"{other} ({value:.2f})" for value, other in others)
        say(console, f"most like it (1 is the same): {said}")


def _learnt(objects: str, name: str) -> str:
    """Whether an object is learnt: "yes", "no", or "changed" if its mesh is another one since."""
    folder, own = learned_folder(objects, OPEN), set_folder(objects)
    try:
        weights = Weights(folder)
        weights.bank(name)
    except (SaccadeError, KeyError):
        return "no"
    if own is not None and digests_of(weights).get(name) != digest(own / name):
        return "changed"
    return "yes"


def _size(size_m) -> str:
    return " x ".join(f"{100 * side:.1f}" for side in size_m)
