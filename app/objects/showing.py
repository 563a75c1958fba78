"""`saccade objects list` and `show`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from saccade.app.objects.cards import TURNTABLE, digest
from saccade.app.objects.learning import digests_of
from saccade.app.objects.page import pairs_of, write_page
from saccade.app.run.display import say
from saccade.shared.config import learned_folder, set_folder
from saccade.shared.errors import LINE_LIMIT, SaccadeError, printable, told
from saccade.shared.model.bank import bank_in
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


def show_object(objects: str, name: str, console: Console, out: Path | None = None) -> None:
    """Prints what is known of an object, and which others look most like it; writes a page about it into the folder
    `out`. Raises SaccadeError if it is not there."""
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
    state = _learnt(objects, name)
    if out is not None:
        say(console, f"written to {write_page(objects, name, out, is_learnt=state == 'yes')}")
    if state != "yes":
        say(console, f"learnt: {state}; `saccade objects learn` does it")
        return
    weights = Weights(learned_folder(objects, OPEN))
    pairs = pairs_of(name, {each: bank_in(weights, each) for each in weights.names})[:ALIKE]
    if pairs:
        said = ", ".join(f"{pair.other} ({pair.similar:.2f})" for pair in pairs)
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
