"""Several of a kind: which percept is of which instance, which are new, which die, and how many there are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from saccade.services.belief.association import assigned, count_probabilities, doubles
from saccade.services.belief.core import BeliefFilter
from saccade.services.belief.position import Evidence, in_view
from saccade.services.perception.networks import CELLS, tally
from saccade.services.perception.several import groups
from saccade.shared.bus.messages import Percept
from saccade.shared.bus.topics import BELIEF, EVENTS
from saccade.shared.config import Config
from saccade.shared.world.geometry import INTRINSICS_PX, look_at, project
from saccade.tests.samples import goal_percept

KIND = "soup_can"
CANS = np.array([[0.10, 0.10, 0.05], [-0.12, 0.05, 0.05], [0.0, -0.15, 0.05]])
NEAR, FAR = CANS[1:2], CANS[0:1]  # told alone, in images that show nothing else


def evidence(mean, deviation_m=0.01) -> Evidence:
    return Evidence(np.array(mean), np.eye(3) * deviation_m ** 2, 0.5, np.array([0.0, 0.0, -1.0]))


def place(mean, deviation_m=0.01):
    return np.array(mean), np.eye(3) * deviation_m ** 2


# --- association

def test_percepts_go_to_the_instances_that_they_fit_all_together():
    """The second percept is a little nearer to the first instance than the first one is, but only this fits both."""
    places = [place([0.0, 0.0, 0.05]), place([0.08, 0.0, 0.05])]
    percepts = [evidence([-0.02, 0.0, 0.05]), evidence([0.03, 0.0, 0.05], 0.03)]
    assert assigned(places, percepts) == [0, 1]
    assert assigned(places[::-1], percepts) == [1, 0]


def test_a_percept_that_fits_no_instance_is_of_none():
    assert assigned([place(CANS[0])], [evidence(CANS[1])]) == [None]
    assert assigned([place(CANS[0]), place(CANS[1])], [evidence(CANS[1])]) == [None, 0]
    assert assigned([], [evidence(CANS[1])]) == []
    assert assigned([place(CANS[0])], []) == [None]


def test_an_instance_of_which_nothing_is_known_takes_what_no_other_explains():
    vague = np.zeros(3) + 0.1, np.diag([0.08, 0.08, 0.02])
    assert assigned([vague, place(CANS[1])], [evidence(CANS[1]), evidence(CANS[0])]) == [1, 0]


def test_of_two_instances_in_one_place_the_better_known_one_stays():
    places = [place(CANS[0]), place(CANS[0] + 0.01, 0.2), place(CANS[1])]
    assert doubles(places, [0.9, 0.99, 0.9], 0.05) == [1]
    assert doubles([place(CANS[0]), place(CANS[0] + 0.01)], [0.6, 0.9], 0.05) == [0]


def test_the_number_of_instances_has_a_probability():
    """Two that are surely there and one that may be: two or three, as likely as this one is."""
    shares = count_probabilities([1.0, 1.0, 0.3])
    np.testing.assert_allclose(shares, [0.0, 0.0, 0.7, 0.3], atol=1e-12)
    assert count_probabilities([0.9, 0.8, 0.4]).sum() == pytest.approx(1.0)


# --- the belief

def percept(step: int, camera, centers) -> Percept:
    """What an image tells that shows cans at `centers`."""
    each = []
    for center in centers:
        pixel, _ = project(np.array(center), camera, INTRINSICS_PX)
        each.append(Percept(
            run="r", episode=0, step=step, object=KIND, presence=0.99, pixel=pixel, pixel_std=3.0,
            scale=0.4 / float(np.linalg.norm(center - camera[:3, 3])), log_scale_std=0.04,
            latent_mean=np.zeros(8, np.float32), latent_std=np.full(8, 0.1, np.float32),
            intrinsics_px=np.array(INTRINSICS_PX), world_from_camera=camera))
    if not each:
        nothing = percept(step, camera, CANS[:1])
        return Percept(**{**vars(nothing), "presence": 0.01})
    return Percept(**{**vars(each[0]), "further": each[1:]})


def camera(step: int, centers):
    """A camera that sees the whole table; of one can alone it is near, so that the others are not in view."""
    angle = 0.25 * step
    if centers is NEAR or centers is FAR:
        return look_at(centers[0] + np.array([0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.25]), centers[0])
    return look_at([0.55 * np.cos(angle), 0.55 * np.sin(angle), 0.45], [0.0, 0.0, 0.05])


def there(told):
    """The instances that are rather there than not."""
    return [each for each in told.each() if each.presence > 0.5]


def believed(images, names=(KIND,)):
    """The last belief about the cans after images that show those at these places, and all events."""
    config = Config().with_values({"scene.names": list(names), "belief.particles": 2000})
    core = BeliefFilter(config, names)
    core.begin("r", 0)
    told, events = None, []
    for step, centers in enumerate(images):
        inputs = {"percept": {KIND: percept(step, camera(step, centers), centers)},
                  "goal_percept": {KIND: goal_percept(KIND)}, "goal": None}
        for output in core.step(inputs):
            told = output.message if output.topic == BELIEF else told
            events += output.message.labels() if output.topic == EVENTS else []
    return told, events


def test_each_can_that_an_image_shows_is_an_instance_of_its_own():
    """Three cans in every image, told in another order each time: three instances, each within 2 cm of its can."""
    told, events = believed([np.roll(CANS, step, axis=0) for step in range(6)])
    found = np.array([each.mean_m for each in there(told)])
    apart = np.linalg.norm(found[:, None] - CANS, axis=2)
    assert apart.shape == (3, 3)
    assert apart.min(0).max() < 0.02
    assert told.count()[0] == 3
    assert told.count()[1] > 0.7  # there may be one more where nobody has looked
    assert events == []


def test_a_thing_that_is_told_twice_in_an_image_is_one():
    """It stays alone of its kind, so that what happens to it is noticed."""
    twice = np.array([CANS[0], CANS[0] + [0.01, 0.0, 0.0]])
    told, events = believed([twice] * 4 + [CANS[2:]] * 4)
    assert len(told.each()) == 1
    assert events == [KIND]


def test_where_nobody_has_looked_there_may_be_one_more():
    """Of several; its particles are where the images so far have not shown that nothing is there."""
    told, _ = believed([CANS[:2]] * 6)
    more = told.each()[-1]
    assert 0.05 < more.presence < 0.3
    seen = in_view(more.particles_m.astype(np.float64), camera(5, CANS), INTRINSICS_PX)
    assert seen.mean() < 0.2
    alone, _ = believed([CANS[:1]] * 6)
    assert len(alone.each()) == 1


def test_instances_keep_their_numbers_whichever_is_seen():
    """Once two were seen together, both stay where they are while only one is in view, and nothing is said to have
    happened."""
    away = [CANS[:2]] * 3 + [NEAR] * 5
    together, _ = believed(away[:3])
    told, events = believed(away)
    numbers = {each.instance: each.mean_m for each in there(together)}
    assert sorted(numbers) == [1, 2]
    assert [each.label() for each in there(told)] == ["soup_can", "soup_can#2"]
    for each in there(told):
        assert np.linalg.norm(each.mean_m - numbers[each.instance]) < 0.02
    assert events == []


def test_an_instance_dies_where_nothing_is_seen():
    """A second can that one image shows, and then ten do not, although its place is in clear view."""
    told, _ = believed([CANS[:2]] + [CANS[:1]] * 10)
    assert len(there(told)) == 1
    assert np.linalg.norm(told.mean_m - CANS[0]) < 0.02
    assert told.count()[0] == 1


def test_a_can_that_is_seen_where_it_was_before_and_elsewhere_is_two():
    """No image shows both. The first is seen, then the other while the first is not in view, then the first again:
    it may have been moved, so that two are not sure; when it is seen where it was, they are."""
    moved, events = believed([CANS[:1]] * 6 + [NEAR] * 4)
    assert max(moved.count_probabilities) < 0.7
    assert events == [KIND]
    told, _ = believed([CANS[:1]] * 6 + [NEAR] * 4 + [FAR] * 4)
    assert told.count()[0] == 2
    found = sorted(each.mean_m[0] for each in there(told))
    np.testing.assert_allclose(found, [CANS[1][0], CANS[0][0]], atol=0.02)


def test_a_can_that_is_there_once_is_one_instance_wherever_it_is_seen():
    """As long as no image shows two, all percepts are of the first instance: then it was moved."""
    told, events = believed([CANS[:1]] * 6 + [CANS[1:2]] * 6)
    assert len(told.each()) == 1
    assert np.linalg.norm(told.mean_m - CANS[1]) < 0.02
    assert KIND in events


# --- perception

def votes_for(centers, *, logit=4.0, half=0.06):
    """Logits and votes of cells that see squares around these centres (u, v), and vote for the right centre."""
    logits, votes = torch.full((CELLS, CELLS), -6.0), torch.zeros(3, CELLS, CELLS)
    at = (torch.arange(CELLS) + 0.5) / CELLS
    for u, v in centers:
        inside = ((at[None] - u).abs() < half) & ((at[:, None] - v).abs() < half)
        logits[inside] = logit
        votes[0] = torch.where(inside, u - at[None], votes[0])
        votes[1] = torch.where(inside, v - at[:, None], votes[1])
    return logits, votes


def test_votes_for_one_place_are_left_as_they_are():
    logits, votes = votes_for([(0.4, 0.5)])
    assert groups(logits, votes, 0.1, 60) == []
    assert groups(torch.full((CELLS, CELLS), -6.0), votes, 0.1, 60) == []


def test_votes_for_several_places_are_several_objects():
    """Each group tallies to its own centre, and owns the part of the mask around it. All together tally to the middle,
    where there is nothing."""
    centers = [(0.25, 0.5), (0.75, 0.5)]
    logits, votes = votes_for(centers)
    found = groups(logits, votes, 0.1, 60)
    told = sorted(tuple(tally(group.vote_logits, votes)[1].tolist()) for group in found)
    np.testing.assert_allclose(told, centers, atol=1e-3)
    assert tally(logits, votes)[1][0] == pytest.approx(0.5, abs=1e-3)
    for group in found:
        u = float(tally(group.vote_logits, votes)[1][0])
        assert bool(group.own[30, round(u * 60)])
        assert not bool(group.own[30, round((1 - u) * 60)])


def test_a_few_stray_votes_are_no_object():
    """Three cells that vote for another place."""
    logits, votes = votes_for([(0.3, 0.5)])
    logits[2, 25:28] = 4.0
    assert groups(logits, votes, 0.1, 60) == []
