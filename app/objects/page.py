"""`saccade objects show --out`: a page about an object, with pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade.app.objects.cards import VIEWS, png, turntable
from saccade.shared.config import learned_folder, set_folder
from saccade.shared.errors import NAME_LIMIT, printable
from saccade.shared.files import replace_all, writing
from saccade.shared.model.bank import Bank, bank_in
from saccade.shared.model.object_card import read_card
from saccade.shared.model.weights import OPEN, Weights
from saccade.shared.render.objects import load_mesh
from saccade.shared.world.geometry import direction, spherical
from saccade.shared.world.symmetry import symmetry_words

ALIKE, IN_MATRIX = 3, 8  # how many others are told in words, and how many objects the matrix has at most
ELEVATIONS_RAD = (1.2, 0.6, 0.1)  # of the views of the bank that are shown
TOLD = ("source", "views", "unit", "up", "licence")  # keys of the card


@dataclass(frozen=True)
class Pair:
    """Two views from above, of an object and of another one, which are the most alike of all; their similarity is 1 if
    they are the same."""

    similar: float
    other: str
    mine: int
    theirs: int


def pairs_of(name: str, banks: dict[str, Bank]) -> list[Pair]:
    """The most alike views of an object and of each other one, the most alike object first."""
    pairs = []
    for other, bank in banks.items():
        if other != name:
            similar = _similar(banks[name], bank)
            mine, theirs = np.unravel_index(int(similar.argmax()), similar.shape)
            pairs.append(Pair(float(similar.max()), other, int(mine), int(theirs)))
    return sorted(pairs, key=lambda pair: -pair.similar)


def own_likeness(bank: Bank) -> float:
    """How alike neighbouring views of one object are: the median of each view's largest similarity to another one."""
    similar = _similar(bank, bank)
    np.fill_diagonal(similar, -1.0)
    return float(np.median(similar.max(1)[bank.directions[:, 2] > 0.0]))


def write_page(objects: str, name: str, out: Path, *, is_learnt: bool) -> Path:
    """Writes `out`/NAME.md and its pictures. Returns the file. Raises SaccadeError if the object's files are damaged,
    or if the page cannot be written."""
    mesh, folder = load_mesh(objects, name), set_folder(objects)
    card = {} if folder is None else read_card(folder / name)
    size = " x ".join(f"{100 * side:.1f}" for side in mesh.size_m)
    rows = [("set", objects), ("size", f"{size} cm (width, depth, height)"), ("faces", str(len(mesh.faces))),
            ("turned about the vertical", symmetry_words(mesh.symmetry)),
            *((key, _cell(card[key])) for key in TOLD if card.get(key))]
    lines = [f"# {name}", "", f"![{name} from all around]({name}-turntable.png)", "", "| | |", "| --- | --- |",
             *(f"| {key} | {value} |" for key, value in rows), ""]
    lines += [f"- {_cell(note)}" for note in card.get("notes") or () if isinstance(note, str)]
    files = {f"{name}-turntable.png": png(turntable(mesh))}
    if is_learnt:
        weights = Weights(learned_folder(objects, OPEN))
        banks = {each: bank_in(weights, each) for each in weights.names}
        files[f"{name}-views.png"] = png(_views(banks[name]))
        lines += ["", "## What is known of it", "",
                  f"The bank holds {len(banks[name].pictures)} views from all around. Here are those from "
                  f"{VIEWS} azimuths and {len(ELEVATIONS_RAD)} elevations.", "",
                  f"![views of {name}]({name}-views.png)"]
        lines += _likeness(name, banks, files)
    else:
        lines += ["", "It is not learnt, or its mesh has changed since: `saccade objects learn` does it."]
    files[f"{name}.md"] = ("\n".join(lines) + "\n").encode()
    with writing(out, "page"):
        out.mkdir(parents=True, exist_ok=True)
        replace_all(out, files)
    return out / f"{name}.md"


def _likeness(name: str, banks: dict[str, Bank], files: dict[str, bytes]) -> list[str]:
    """What the object may be taken for: the most alike others in words and pictures, and a matrix."""
    pairs = pairs_of(name, banks)
    lines = ["", "## What it may be taken for", ""]
    if not pairs:
        return [*lines, "There is no other object in the set."]
    own = own_likeness(banks[name])
    lines += [f"A similarity of 1 means the same. Neighbouring views of {name} itself have {own:.2f}: another object "
              "whose views come near to this will be mistaken for it.", ""]
    for number, pair in enumerate(pairs[:ALIKE], 1):
        picture = f"{name}-like-{number}.png"
        files[picture] = png(np.concatenate([banks[name].image(pair.mine)[..., :3],
                                             banks[pair.other].image(pair.theirs)[..., :3]], axis=1))
        lines += [f"{number}. **{pair.other}**, {pair.similar:.2f}, where {name} is seen from "
                  f"{_from(banks[name], pair.mine)} and {pair.other} from {_from(banks[pair.other], pair.theirs)}: "
                  f"{'as alike as its own views' if pair.similar >= own else 'less alike than its own views'}.", "",
                  f"    ![{name} and {pair.other}]({picture})", ""]
    shown = [name, *(pair.other for pair in pairs[:IN_MATRIX - 1])]
    lines += ["The largest similarity of two views from above:", "", "| | " + " | ".join(shown) + " |",
              "| --- |" + " ---: |" * len(shown)]
    for one in shown:
        cells = (own_likeness(banks[one]) if one == two else float(_similar(banks[one], banks[two]).max())
                 for two in shown)
        lines.append(f"| {one} | " + " | ".join(f"{value:.2f}" for value in cells) + " |")
    left = len(banks) - len(shown)
    return [*lines, "", "On the diagonal stand neighbouring views of one object."
            + (f" {left} objects that are less alike are left out." if left else "")]


def _similar(one: Bank, other: Bank) -> NDArray[np.float64]:
    """The similarities of the views of two banks [V, W]. Views from below count as unlike: objects stand."""
    above = [np.where(bank.directions[:, 2:] > 0.0, bank.vectors.astype(np.float64), 0.0) for bank in (one, other)]
    return np.asarray(above[0] @ above[1].T)


def _views(bank: Bank) -> NDArray[np.uint8]:
    """Views of a bank, an elevation in each row [3 * 64, 8 * 64, 3]."""
    rows = []
    for elevation in ELEVATIONS_RAD:
        numbers = [int(np.argmax(bank.directions @ direction(azimuth, elevation)))
                   for azimuth in 2 * np.pi / VIEWS * np.arange(VIEWS)]
        rows.append(np.concatenate([bank.image(number)[..., :3] for number in numbers], axis=1))
    return np.concatenate(rows, axis=0)


def _from(bank: Bank, view: int) -> str:
    """The direction of a view in words."""
    azimuth, elevation, _ = spherical(bank.directions[view], np.zeros(3))
    return f"azimuth {np.degrees(azimuth):.0f}°, elevation {np.degrees(elevation):.0f}°"


def _cell(value: Any) -> str:
    """A value from a card, as a page shows it."""
    return printable(str(value), NAME_LIMIT).replace("|", "\\|").replace("<", "&lt;")
