"""What an agent notices is judged by the truth: what could be seen, when, and what was reported of nothing."""

from __future__ import annotations

import numpy as np

from saccade.app.bench.noticing import WITHIN, Noticed, noticed
from saccade.app.bench.table import noticed_words
from saccade.shared.bus.messages import Events, Truth
from saccade.shared.world.geometry import look_at

CAMERA, AWAY = look_at((0.5, 0.0, 0.4), (0.0, 0.0, 0.05)), look_at((0.5, 0.0, 0.4), (1.0, 0.0, 0.2))
HERE, THERE = np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.15, 0.05])
STAMP = {"run": "r", "episode": 0}


def truth(step, place, *, camera=CAMERA, in_view=1.0, done=False) -> Truth:
    """The mug at a place, or nowhere, beside a box that stands still."""
    names, centers = ["box"], [np.array([-0.2, -0.2, 0.05])]
    if place is not None:
        names, centers = [*names, "mug"], [*centers, place]
    count = len(names)
    return Truth(**STAMP, step=step, scene="s", target="mug", names=names, centers_m=np.array(centers),
                 yaws_rad=np.zeros(count), keep_out_m=np.ones(count), target_center_m=HERE, world_from_camera=camera,
                 goal_world_from_camera=CAMERA, success=False, done=done, sizes_m=np.full((count, 3), 0.08),
                 rotations=np.tile(np.eye(3), (count, 1, 1)), in_view=np.array([1.0, in_view][:count]))


def report(step, *objects) -> Events:
    return Events(**STAMP, step=step, objects=list(objects), kinds=["moved"] * len(objects),
                  positions_m=np.zeros((len(objects), 3)), probabilities=np.ones(len(objects)),
                  instances=np.ones(len(objects), dtype=np.uint8))


def moved(at=3, count=20, **more):
    return [truth(step, HERE if step < at else THERE, **more) for step in range(count)]


def test_a_change_is_to_be_reported_within_some_images():
    assert noticed(moved(), [report(5, "mug")]) == Noticed(1, 1, 0)
    assert noticed(moved(), [report(3 + WITHIN, "mug")]) == Noticed(1, 1, 0)
    assert noticed(moved(), [report(4 + WITHIN, "mug")]) == Noticed(1, 0, 0)
    assert noticed(moved(), []) == Noticed(1, 0, 0)


def test_a_report_of_nothing_is_false():
    """Before anything happened, of another object, or long after the first report; not soon after it."""
    assert noticed(moved(), [report(2, "mug"), report(5, "mug")]) == Noticed(1, 1, 1)
    assert noticed(moved(), [report(5, "mug", "box")]) == Noticed(1, 1, 1)
    assert noticed(moved(), [report(5, "mug"), report(8, "mug")]) == Noticed(1, 1, 0)
    assert noticed(moved(), [report(5, "mug"), report(15, "mug")]) == Noticed(1, 1, 1)
    assert noticed([truth(step, HERE) for step in range(9)], [report(4, "mug")]) == Noticed(0, 0, 1)


def test_the_images_count_from_the_first_that_shows_the_change():
    """While the object is out of view nothing can be noticed. An episode that ends before long decides nothing."""
    hidden = [truth(step, HERE if step < 3 else THERE, in_view=float(step < 3 or step >= 12)) for step in range(25)]
    assert noticed(hidden, [report(12 + WITHIN, "mug")]) == Noticed(1, 1, 0)
    assert noticed(hidden[:12], []) == Noticed(0, 0, 0)
    assert noticed(hidden[:14], []) == Noticed(0, 0, 0)
    assert noticed(hidden[:14], [report(13, "mug")]) == Noticed(1, 1, 0)


def test_that_it_has_left_may_be_reported_long_before_where_it_is():
    """Its empty place is seen at once, and the object much later; what is reported long after this is false."""
    hidden = [truth(step, HERE if step < 3 else THERE, in_view=float(step < 3 or step >= 15)) for step in range(30)]
    assert noticed(hidden, [report(5, "mug"), report(16, "mug")]) == Noticed(1, 1, 0)
    assert noticed(hidden, [report(5, "mug"), report(16, "mug"), report(25, "mug")]) == Noticed(1, 1, 1)


def test_what_was_taken_is_noticed_where_its_place_is_in_view():
    taken = [truth(step, HERE if step < 3 else None) for step in range(15)]
    assert noticed(taken, []) == Noticed(1, 0, 0)
    assert noticed(taken, [report(6, "mug")]) == Noticed(1, 1, 0)
    elsewhere = [truth(step, HERE if step < 3 else None, camera=CAMERA if step < 3 else AWAY) for step in range(15)]
    assert noticed(elsewhere, []) == Noticed(0, 0, 0)


def test_what_was_put_back_before_anybody_looked_is_no_change():
    """With an image of the empty place there are two changes."""
    def there(step, looks):
        return truth(step, None if 3 <= step < 9 else HERE, camera=AWAY if 3 <= step < 9 and not looks else CAMERA)

    assert noticed([there(step, False) for step in range(20)], []) == Noticed(0, 0, 0)
    assert noticed([there(step, True) for step in range(20)], [report(5, "mug"), report(10, "mug")]) == Noticed(2, 2, 0)


def test_a_drift_is_one_change_and_every_report_of_it_is_right():
    drifting = [truth(step, HERE + np.array([0.0, 0.005 * max(step - 2, 0), 0.0])) for step in range(30)]
    assert noticed(drifting, [report(6, "mug"), report(14, "mug"), report(25, "mug")]) == Noticed(1, 1, 0)


def test_the_table_tells_both_shares():
    """Agents that tell no events are left out."""
    records = [{"changes": 2, "noticed": 1, "false_events": 0}, {"changes": 0, "noticed": 0, "false_events": 3}]
    words = noticed_words([*records, {"success": True}])
    assert words.startswith(f"noticed within {WITHIN} images: 50.0 % (")
    assert "of 2 changes" in words
    assert "no event reported where there was none: in 50.0 % (" in words
    assert noticed_words(records[1:]).startswith("no event reported where there was none: in 0.0 %")
    assert noticed_words([{"success": True}]) == ""
