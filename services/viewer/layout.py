"""The layout of the viewer's screen, and its colours."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint import Horizontal, Spatial2DView, Spatial3DView, Tabs, TextLogView, TimeSeriesView, Vertical

from saccade.shared.world.geometry import IMAGE_SIZE_PX

Colour = tuple[int, int, int]

STEP = "step"
OBJECTS: tuple[Colour, ...] = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75), (227, 119, 194),
    (188, 189, 34), (23, 190, 207))
PATH, TRUE, PLANNED, TABLE = (150, 150, 150), (230, 30, 230), (255, 200, 0), (90, 90, 90)
BACKGROUND = (20, 22, 26)
EYE_M, EYE_TARGET_M = (0.62, -0.86, 0.72), (0.0, 0.0, 0.12)
VIEW_PX = 240  # side of the planned view
CELL_PX, ROW_PX, NAME_PX = 120, 66, 24  # picture of the crops: width of a column, height of a row and of a name
STEPS_PER_S = 5.0
CURVES = {
    "distance": "distance to the goal (m)", "entropy": "entropy of each position (nats)", "F": "free energy F (nats)",
    "G": "expected free energy G (nats)", "presence": "presence", "milliseconds": "milliseconds per step",
    "dropped": "messages dropped"}


def colour_of(number: int) -> Colour:
    """The colour of an object, by its number among the objects of the run."""
    return OBJECTS[number % len(OBJECTS)]


def between(share: float) -> Colour:
    """The colour of a candidate, from the best one (0: green) to the worst one that is shown (1: red)."""
    return round(255 * min(1.0, 2 * share)), round(200 * min(1.0, 2 - 2 * share)), 40


def layout(*, live: bool, objects: int) -> rrb.Blueprint:
    """The arrangement of the views: on the left the world above the decisions, on the right the images and curves.

    In a live run the newest step is shown; a log is played. `objects` is the number of crops.
    """
    world = Spatial3DView(origin="world", name="world", background=BACKGROUND, eye_controls=rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=EYE_M, look_target=EYE_TARGET_M, eye_up=(0.0, 0.0, 1.0)))
    images = Horizontal(_image("world/camera/image", "camera", IMAGE_SIZE_PX),
                        _image("goal/image", "goal", IMAGE_SIZE_PX),
                        _image("world/viewpoint/imagined", "planned view", VIEW_PX))
    crops = _image("crops", "crops, and their reconstructions", max(objects, 1) * CELL_PX,
                   2 * ROW_PX + NAME_PX)
    curves = {origin: TimeSeriesView(origin=origin, name=name, plot_legend=rrb.Corner2D.RightTop)
              for origin, name in CURVES.items()}
    first = [curves.pop(origin) for origin in ("distance", "entropy")]
    return rrb.Blueprint(
        Horizontal(Vertical(world, TextLogView(origin="decisions", name="decisions"), row_shares=[4, 1]),
                   Vertical(images, crops, Horizontal(*first), Tabs(*curves.values()), row_shares=[5, 3, 4, 4]),
                   column_shares=[1, 1]),
        rrb.TimePanel(timeline=STEP, state="collapsed", fps=STEPS_PER_S, play_state="following" if live else "playing"),
        rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))


def _image(origin: str, name: str, width_px: float, height_px: float | None = None) -> Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(0, width_px), y_range=(0, height_px or width_px))
    return Spatial2DView(origin=origin, name=name, visual_bounds=bounds)
