"""The report: its numbers from a results file made by hand, its pictures, scenes run again, failures by their cause."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from saccade.app.bench.bench import bench, prepare
from saccade.app.bench.charts import draw_exploration, explore, pick
from saccade.app.bench.failures import CLASSES, Diagnosis, Distance, diagnose, section
from saccade.app.bench.repeat import prepare_again, read_results, replay, same_as
from saccade.app.bench.report import conduct, report, side_by_side, training
from saccade.app.look.picture import Story
from saccade.shared.bus.messages import Belief, Plan, Result, Truth
from saccade.shared.config import WEIGHTS, Config
from saccade.shared.errors import SaccadeError
from saccade.shared.model.weights import Weights
from saccade.shared.world.geometry import direction, look_at, viewing_grid
from saccade.tests.fakes.weights import write_random_weights
from saccade.tests.samples import sample


def record(scene, success=True, azimuth=0.1, steps=10, **more):
    return {"scene": scene, "target": "003_cracker_box", "objects": 1, "success": success, "steps": steps,
            "azimuth_error_rad": azimuth, "elevation_error_rad": 0.2, "range_error_m": 0.05, "declared": True,
            "declared_true": success, "seconds": 1.0, "milliseconds": {"belief": 20.0}} | more


def write(path, records, **more):
    facts = {"command": "c", "commit": "abc", "agent": "sceneccn", "objects": "ycb", "weights": {"a": "0123456789"},
             "machine": {"processor": "P"}, "scenes": {"suite": "dev", "file": "s.json", "sha256": "ff"},
             "config": Config().model_dump(mode="json")}
    path.write_text(json.dumps(facts | more | {"results": records}))
    return path


def silent() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.fixture(scope="module")
def oracle_file(tmp_path_factory):
    """Results of the oracle, which fails the scenes that take more than six steps."""
    out = tmp_path_factory.mktemp("oracle") / "oracle.json"
    config = Config().with_values({"simulator.max_steps": 6})
    bench(prepare("oracle", config, out, suite="dev", limit=4), jobs=1, command="c", console=silent())
    return out


def test_numbers_and_pictures_of_a_small_file(tmp_path):
    """Two of four; by hand: Wilson 15.0 to 85.0 %, azimuth 0.25 with standard error 0.0645."""
    records = [record("a", azimuth=0.1), record("b", azimuth=0.2, steps=20), record("c", False, azimuth=0.3, steps=350),
               record("d", False, azimuth=0.4, steps=350, declared=False)]
    files = [write(tmp_path / "ours.json", records), write(tmp_path / "floor.json", records[:1], agent="oracle")]
    report([files[1], files[0], tmp_path / "x.scenes.json"], tmp_path / "out", reruns=False, console=silent())
    text = (tmp_path / "out" / "report.md").read_text()
    total = next(line for line in text.splitlines() if line.startswith("| Total"))
    assert total == ("| Total | 50.0 (15.0 to 85.0) | 69.0 | 0.250 ± 0.065 | 0.569 ± 0.034 | 0.200 ± 0.000 | "
                     "0.231 ± 0.014 | 0.050 ± 0.000 | 0.067 ± 0.004 |")
    assert "| oracle, ycb, dev (floor) | 100.0 (20.7 to 100.0) | 0.100 | 0.200 | 0.050 |" in text
    assert "| paper: SceneCCN + AIF, its 500 scenes | 69.0 | 0.569 ± 0.034 | 0.231 ± 0.014 | 0.067 ± 0.004 |" in text
    assert "| sceneccn, ycb, dev | 185 (17.5 to 350) | 50.0 | - | - | - | 25.0 | belief 20.0 |" in text
    assert "| sceneccn, ycb, dev | ours.json | 4 | ff | abc | 01234567 | P |" in text
    for name in ("errors", "objects", "steps"):
        assert f"(report/{name}.png)" in text
        with Image.open(tmp_path / "out" / "report" / f"{name}.png") as picture:
            assert min(picture.size) > 100


def test_the_agents_own_word_is_counted_where_it_ends_the_episode(tmp_path):
    """Of four it declares three, two of them rightly; in one of these it was there and had left again."""
    config = Config().with_values({"simulator.until": "declared"}).model_dump(mode="json")
    records = [record("a"), record("b"), record("c", declared_true=False), record("d", False, declared=False)]
    row = conduct([read_results(write(tmp_path / "own.json", records, config=config))])[-2]
    assert "| 75.0 | 75.0 | 66.7 | 50.0 | 25.0 |" in row


def test_runs_of_the_same_scenes_are_compared_one_by_one(tmp_path):
    """The second, with a configuration of its own, loses scene b and gains scene c; another suite is not compared."""
    base = write(tmp_path / "base.json", [record("a"), record("b"), record("c", False)])
    changed = Config().with_values({"belief.pose": "last", "seed": 0}).model_dump(mode="json")
    other = write(tmp_path / "last.json", [record("a"), record("b", False), record("c")], config=changed)
    apart = write(tmp_path / "apart.json", [record("d")], scenes={"suite": "yaw-500", "file": "t.json", "sha256": "ee"})
    lines = side_by_side([read_results(path) for path in (base, other, apart)])
    row = next(line for line in lines if line.startswith("| last"))
    assert row.startswith("| last | belief.pose=last | 66.7 | +1, -1 |")
    assert sum(line.startswith("| ") for line in lines) == 4  # two headers, two files


def test_training_is_told_of_the_weights_that_made_the_results(tmp_path):
    """By the shipped manifest; a file that other weights made says nothing."""
    weights = Weights(WEIGHTS / "pantry")
    config = Config().with_values({"scene.objects": "pantry"}).model_dump(mode="json")
    own = write(tmp_path / "own.json", [record("a")], config=config, weights=weights.hashes)
    other = write(tmp_path / "other.json", [record("a")], config=config)
    row = training([read_results(own)])[-2]
    hours = weights.manifest["seconds"] / 3600
    assert row.startswith(f"| pantry | {weights.manifest['where_trained']} | {hours:.1f} |")
    assert training([read_results(other)]) == []


def test_files_that_are_no_results_are_said_in_one_line(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    for path, words in ((tmp_path / "a.json", "not of `saccade bench`"), (tmp_path / "b.json", "cannot be read"),
                        (write(tmp_path / "c.json", []), "no result is in it")):
        with pytest.raises(SaccadeError, match=words):
            read_results(path)
    (tmp_path / "d").mkdir()
    twice = [write(tmp_path / "e.json", [record("a")]), write(tmp_path / "d" / "e.json", [record("a")])]
    with pytest.raises(SaccadeError, match="2 results files are called e"):
        report(twice, tmp_path / "out", console=silent())
    with pytest.raises(SaccadeError, match="no results are given"):
        report([tmp_path / "x.scenes.json"], tmp_path / "out", console=silent())


def test_worst_and_middle_cases():
    """Failed before reached, then by the errors."""
    records = [record(str(k), azimuth=0.1 * k) for k in range(9)] + [record("failed", False, azimuth=0.0)]
    worst, middle = pick(records)
    assert [r["scene"] for r in worst] == ["failed", "8", "7"]
    assert [r["scene"] for r in middle] == ["6", "5", "4"]
    assert [[r["scene"] for r in part] for part in pick(records[:2])] == [["1", "0"], []]


def test_a_scene_run_again_ends_as_in_the_results(oracle_file, tmp_path):
    """Its scenes are found beside the results, or drawn anew from the suite's name."""
    results = read_results(oracle_file)
    for path in (oracle_file, write(tmp_path / "moved.json", results.records, **results.facts)):
        again = prepare_again(read_results(path), tmp_path)
        story = replay(*again.arguments(results.records[1]["scene"]))
        assert same_as(story, results.records[1])
        assert not same_as(story, results.records[1] | {"steps": 99})
        assert (story.last_rgb.shape, story.goal_rgb.shape) == ((480, 480, 3),) * 2
        assert story.last_step == results.records[1]["steps"] == len(story.path_m) - 1


def test_other_scenes_or_weights_are_not_run(oracle_file, tmp_path):
    results = read_results(oracle_file)
    scenes = results.facts["scenes"] | {"sha256": "00"}
    with pytest.raises(SaccadeError, match="are not to be found"):
        prepare_again(replace(results, facts=results.facts | {"scenes": scenes}), tmp_path)
    with pytest.raises(SaccadeError, match="does not hold the weights of"):
        prepare_again(replace(results, facts=results.facts | {"weights": {"a": "1"}}), tmp_path)


def test_report_with_episodes_and_failures(oracle_file, tmp_path):
    """End to end with the oracle: gallery, and the failed scenes with their pictures."""
    report([oracle_file], tmp_path, failures=True, console=silent())
    assert "(report/gallery_oracle.png)" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "report" / "gallery_oracle.png").is_file()
    text = (tmp_path / "failures.md").read_text()
    failed = [r["scene"] for r in read_results(oracle_file).records if not r["success"]]
    assert f"{len(failed)} of 4 scenes failed." in text
    assert failed
    for scene in failed:
        assert f"(failures/oracle/{scene}.png)" in text
        assert (tmp_path / "failures" / "oracle" / f"{scene}.png").is_file()
    assert CLASSES["other"][0] not in text


def test_exploration_keeps_the_beliefs_at_the_views_asked_for(tmp_path):
    """With weights that have learnt nothing."""
    names = ("coffee_can", "soup_can")
    write_random_weights(tmp_path / "w", "pantry", names)
    config = Config().with_values({"scene.names": list(names), "perception.weights": str(tmp_path / "w"),
                                   "simulator.max_steps": 1, "planner.candidates": 50})
    out = tmp_path / "r.json"
    bench(prepare("sceneccn", config, out, suite="dev", limit=1), jobs=1, command="c", console=silent())
    found = explore(prepare_again(read_results(out), tmp_path, tmp_path / "w"), views=(1, 3))
    steps = {views: {belief.step for belief in kept.values()} for views, kept in found.beliefs.items()}
    assert steps == {1: {0}, 3: {2}}
    assert all(set(kept) == set(names) for kept in found.beliefs.values())
    assert found.story.goal_rgb is None
    draw_exploration(found, tmp_path / "e.png")
    assert (tmp_path / "e.png").is_file()


# --- causes

GOOD = Diagnosis("s", "mug", False, True, 350, "mug", 0.01, 0.1, Distance(0.09, 0.2, 0.1), 0.1)


@pytest.mark.parametrize(("changes", "cause"), [
    ({}, "miss"), ({"inferred": "can", "position_error_m": 0.5}, "target"), ({"inferred": ""}, "target"),
    ({"position_error_m": 0.081, "direction_error_rad": 2.0}, "lost"), ({"direction_error_rad": 0.51}, "direction"),
    ({"least_direction_rad": 0.51}, "travel"), ({"success": True}, "other"),
    ({"inferred": None, "position_error_m": None, "direction_error_rad": None}, "miss")])
def test_the_first_thing_that_went_wrong_is_the_cause(changes, cause):
    assert replace(GOOD, **changes).cause == cause


def test_diagnosis_compares_belief_and_truth():
    """The target believed 5 cm off; the posterior's peak one cell, 5 degrees of azimuth, from the truth."""
    elevation, azimuth = viewing_grid()
    center = np.array([0.1, 0.0, 0.05])
    goal = look_at(center + 0.4 * direction(azimuth[10], elevation[2]), center)
    posterior = np.full((len(elevation), len(azimuth)), -9.0, dtype=np.float32)
    posterior[2, 11] = 0.0
    truth = sample(Truth, target="mug", target_center_m=center, goal_world_from_camera=goal)
    belief = sample(Belief, object="mug", mean_m=center + np.array([0.05, 0, 0]), goal_log_posterior=posterior)
    result = sample(Result, scene="s", target="mug", success=False, declared=False, steps=9)
    story = Story(0, beliefs={"mug": belief}, truth=truth, plan=sample(Plan, target="can"), result=result)
    ways = [Distance(0.3, 0.1, 0.2), Distance(0.1, 0.6, 0.4)]
    found = diagnose(story, ways)
    assert found.position_error_m == pytest.approx(0.05)
    assert found.direction_error_rad == pytest.approx(np.radians(5) * np.cos(elevation[2]), rel=1e-2)
    assert (found.inferred, found.nearest, found.least_direction_rad) == ("can", ways[1], 0.2)
    blind = diagnose(replace(story, beliefs={"mug": replace(belief, goal_log_posterior=None)}), ways)
    assert blind.direction_error_rad == np.pi
    told = diagnose(replace(story, beliefs={}, plan=None), ways)
    assert (told.inferred, told.position_error_m, told.direction_error_rad) == (None, None, None)


def test_the_page_of_failures_gives_shares():
    text = "\n".join(section("ours", 8, [(GOOD, "a.png"), (replace(GOOD, inferred=""), "b.png")]))
    assert "2 of 8 scenes failed." in text
    assert "| Near miss | 1 | 50.0 % | 12.5 % |" in text
    assert "| Target not found | 0 | 0.0 % | 0.0 % |" in text
    assert "target inferred: none; believed 1.0 cm off" in text
    assert "![s](b.png)" in text
    assert "0 of 3 scenes failed." in "\n".join(section("ours", 3, []))
