"""The benchmark: its figures, its choice of scenes; neither an interruption nor the number of jobs changes a result."""

from __future__ import annotations

import io
import json
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from rich.console import Console

import saccade.app.bench.bench as bench_module
from saccade.app.bench.bench import Plan, bench, prepare, run_scene, spread
from saccade.app.bench.counting import Counted
from saccade.app.bench.suites import suite_file
from saccade.app.bench.table import PAPER, TOTAL, mean, milliseconds, render, rows, wilson
from saccade.app.run.launch import PROCESSES
from saccade.app.run.registry import AGENTS, agent_pairs, agent_processes, local_pairs
from saccade.services.simulator.scenes import PAPER_SCENES, load_scenes
from saccade.shared.bus.topics import ACTION, RESULT
from saccade.shared.config import Config
from saccade.shared.errors import SaccadeError
from saccade.shared.log import provenance
from saccade.shared.loop.local import run_local
from saccade.tests.fakes.weights import write_random_weights


def record(target="mug", success=True, azimuth=0.1, steps=10, declared=True, declared_true=True, **more):
    return {"scene": f"{target}-{azimuth}", "target": target, "objects": 1, "success": success, "steps": steps,
            "azimuth_error_rad": azimuth, "elevation_error_rad": 2 * azimuth, "range_error_m": azimuth / 2,
            "declared": declared, "declared_true": declared_true, "seconds": 1.0} | more


def text_of(table) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()


def run_bench(plan: Plan, jobs: int = 1) -> list[dict]:
    return bench(plan, jobs=jobs, command="saccade bench", console=Console(file=io.StringIO()))


def timeless(records: list[dict]) -> list[dict]:
    return [{k: v for k, v in r.items() if k not in ("seconds", "milliseconds")} for r in records]


# --- the table

def test_wilson_against_published_values():
    """8 of 10 and 0 of 10, as in the textbooks' tables of the score interval; a whole success reaches 1."""
    eight, none, all_ = wilson(8, 10), wilson(0, 10), wilson(10, 10)
    assert (eight.value, eight.low, eight.high) == pytest.approx((0.8, 0.4902, 0.9433), abs=5e-5)
    assert (none.low, none.high) == pytest.approx((0.0, 0.2775), abs=5e-5)
    assert (all_.low, all_.high) == pytest.approx((0.7225, 1.0), abs=5e-5)
    for bad in ((0, 0), (3, 2)):
        with pytest.raises(ValueError, match="trials"):
            wilson(*bad)


def test_mean_against_hand_computed_values():
    """1, 2, 3, 4: deviation sqrt(5/3), standard error half of it."""
    estimate = mean([1.0, 2.0, 3.0, 4.0])
    assert estimate.value == 2.5
    assert estimate.standard_error == pytest.approx(0.6454972)
    assert (estimate.low, estimate.high) == pytest.approx((1.2348488, 3.7651512))
    assert mean([7.0]).standard_error is None


def test_rows_per_target_and_total():
    """One target solved of two, another not at all; one wrong declaration."""
    records = [record("mug", azimuth=0.1, steps=10), record("mug", False, azimuth=0.3, steps=350, declared=False),
               record("can", False, azimuth=0.5, steps=350, declared_true=False)]
    mug, can, total = rows(records)
    assert (mug.name, mug.scenes, mug.success.value, mug.median_steps) == ("mug", 2, 0.5, 180)
    assert [e.value for e in mug.means] == pytest.approx([0.2, 0.4, 0.1])
    assert (mug.declared, mug.declared_true, can.declared_true) == (0.5, 1.0, 0.0)
    assert (total.name, total.scenes, total.success.value, total.median_steps) == (TOTAL, 3, pytest.approx(1 / 3), 350)
    assert (total.declared, total.declared_true) == (pytest.approx(2 / 3), 0.5)
    assert (mug.false_alarms, can.false_alarms, total.false_alarms) == (0.0, 1.0, pytest.approx(1 / 3))
    assert (mug.middle_steps, can.middle_steps) == ((95.0, 265.0), (350, 350))


def test_milliseconds_are_means_over_all_steps():
    """A longer episode counts for more; records without times, of an older file, count for nothing."""
    spent = [record(steps=1, milliseconds={"belief": 10.0}), record(steps=3, milliseconds={"belief": 30.0}), record()]
    assert milliseconds(spent) == {"belief": 25.0}
    assert milliseconds([record()]) == {}
    assert "milliseconds per step: belief 25.0" in text_of(render(spent, title="t"))


def test_paper_figures_stand_beside_ours_and_say_what_they_are_of():
    """Per object for the paper's objects; for others the total alone, labelled."""
    theirs = text_of(render([record("003_cracker_box"), record("003_cracker_box", azimuth=0.2)], title="t"))
    assert "66.0" in theirs
    assert "0.569 ± 0.034" in theirs
    assert "paper (YCB)" not in theirs
    ours = text_of(render([record("coffee_can"), record("coffee_can", azimuth=0.2)], title="t"))
    assert ours.count("paper (YCB)") == 1
    assert "0.569 ± 0.034" in ours
    assert "0.150 ± 0.050" in ours


def test_paper_total_is_the_mean_of_its_objects():
    """The paper's rows are of equally many scenes, so a slip of the pen in one shows."""
    objects = [figures for name, figures in PAPER.items() if name != TOTAL]
    assert sum(f.success_percent for f in objects) / 5 == pytest.approx(PAPER[TOTAL].success_percent, abs=0.06)
    for i, value in enumerate(PAPER[TOTAL].means):
        assert sum(f.means[i] for f in objects) / 5 == pytest.approx(value, abs=0.001)


# --- which scenes

def test_limit_is_spread_evenly():
    """For every limit, targets and object counts each differ by at most one; 25 takes every pair once."""
    scenes = load_scenes(PAPER_SCENES)
    for limit in range(1, 60):
        chosen = [scenes[number] for number in spread(scenes, limit)]
        assert len({scene.id for scene in chosen}) == limit
        for counts in (Counter(s.target for s in chosen), Counter(len(s.objects) for s in chosen)):
            values = [*counts.values(), *[0] * (5 - len(counts))]
            assert max(values) - min(values) <= 1, limit
    assert len({(scenes[n].target, len(scenes[n].objects)) for n in spread(scenes, 25)}) == 25
    assert spread(scenes, 25) == spread(scenes, 25)
    assert spread(scenes, None) == spread(scenes, 1000) == tuple(range(500))


def test_registry_and_launcher_agree():
    """The agent of the default run is the launcher's list of processes."""
    assert agent_processes("sceneccn") == PROCESSES
    with pytest.raises(SaccadeError, match="--bus local"):
        agent_processes("oracle")
    with pytest.raises(SaccadeError, match="unknown: choose from"):
        agent_pairs("nobody", Config())
    for agent in AGENTS.values():
        assert agent.services or agent.cores


# --- the runs

def test_oracle_solves_pantry_scenes(tmp_path):
    """End to end, in processes of their own: scenes drawn, run, written, summed up."""
    out = tmp_path / "o.json"
    records = run_bench(prepare("oracle", Config(), out, limit=5), jobs=2)
    written = json.loads(out.read_text())
    assert written["results"] == records
    assert [r["success"] for r in records] == [True] * 5
    assert len({r["target"] for r in records}) == 5
    assert {"command", "commit", "weights", "machine", "config", "scenes", "agent", "objects"} <= written.keys()
    assert set(records[0]) == {"scene", "target", "objects", "success", "steps", "azimuth_error_rad", "seconds",
                               "elevation_error_rad", "range_error_m", "declared", "declared_true", "milliseconds"}
    assert all(r["milliseconds"].keys() == {"simulator", "oracle", "evaluator"} for r in records)
    assert written["scenes"]["suite"] == "paper-like"
    assert list(tmp_path.glob("*.partial*")) == []


def test_interrupted_run_is_taken_up_again_with_the_same_outcome(tmp_path, monkeypatch):
    """Stopped after two of five, with half a line written: the rest alone is run, and the file is as without it."""
    drawn = Config(scene={"file": suite_file("paper-like", Config(), tmp_path / "scenes.json")})
    whole, plan = tmp_path / "whole.json", prepare("oracle", drawn, tmp_path / "o.json", limit=5)
    run_bench(prepare("oracle", drawn, whole, limit=5), jobs=2)
    records, asked = bench_module._records, []

    def stop_after_two(plan, numbers, *how):
        for count, result in enumerate(records(plan, numbers, *how)):
            if count == 2:
                raise KeyboardInterrupt
            yield result

    monkeypatch.setattr(bench_module, "_records", stop_after_two)
    with pytest.raises(KeyboardInterrupt, match="2 scenes"):
        run_bench(plan)
    assert not plan.out.exists()
    with plan.partial.open("a") as partial:
        partial.write('{"scene": "cut')
    monkeypatch.setattr(bench_module, "_records", lambda p, n, *how: asked.extend(n) or records(p, n, *how))
    run_bench(plan)
    assert len(asked) == 3
    first, second = (json.loads(path.read_text()) for path in (whole, plan.out))
    assert timeless(first.pop("results")) == timeless(second.pop("results"))
    assert first == second


def test_results_of_another_run_are_not_mixed_in(tmp_path, monkeypatch):
    """Another seed, other scenes, or an object whose card tells another symmetry: a line that names the file and what
    differs."""
    plan = prepare("oracle", Config(), tmp_path / "o.json", limit=1)
    file = plan.config.scene.file
    bench_module._take_up(plan, bench_module.facts(plan, "c"))
    other = prepare("oracle", Config(seed=1, scene={"file": file}), plan.out, limit=1)
    with pytest.raises(SaccadeError, match=r"o\.json\.partial\.jsonl holds results of another run \(its config differ"):
        run_bench(other)
    with monkeypatch.context() as patch:
        patch.setattr(bench_module, "symmetries", lambda objects, names: {"rice_box": 2, "soup_can": 1})
        assert bench_module.facts(plan, "c")["scenes"]["symmetry"] == {"rice_box": 2}
        with pytest.raises(SaccadeError, match="its scenes differ"):
            run_bench(plan)
    file.write_text(file.read_text().replace("yaw_rad", "yaw_rad", 1) + " ")
    with pytest.raises(SaccadeError, match="its scenes differ"):
        run_bench(plan)


def test_a_setting_that_came_later_does_not_make_held_results_another_runs(tmp_path):
    """It counts as its default there. A setting that is there and differs still makes them another run's."""
    plan = prepare("oracle", Config(), tmp_path / "o.json", limit=1)
    origin = bench_module.facts(plan, "c")
    older = json.loads(json.dumps(origin))
    del older["config"]["planner"]["candidates"], older["config"]["viewer"]
    assert bench_module.differing(older, origin) == []
    older["config"]["planner"]["step_m"] = 0.01
    assert bench_module.differing(older, origin) == ["config"]
    older["config"]["planner"]["step_m"] = origin["config"]["planner"]["step_m"]
    origin["config"]["planner"]["candidates"] += 1
    assert bench_module.differing(older, origin) == ["config"]


def test_scene_that_fails_keeps_the_others(tmp_path):
    """Weights that are damaged after the start: one line with the scene, and the earlier results are still there."""
    names = ("coffee_can", "soup_can")
    write_random_weights(tmp_path / "w", "pantry", names)
    config = Config().with_values({"scene.names": list(names), "perception.weights": str(tmp_path / "w"),
                                   "simulator.max_steps": 2})
    plan = prepare("sceneccn", config, tmp_path / "o.json", limit=2)
    bench_module._take_up(plan, bench_module.facts(plan, "c"))
    with plan.partial.open("a") as partial:
        partial.write(json.dumps(record(scene=plan.scenes[plan.chosen[0]].id)) + "\n")
    (tmp_path / "w" / "extraction.safetensors").write_bytes(b"no")
    second = plan.scenes[plan.chosen[1]].id
    with pytest.raises(SaccadeError, match=rf"scene {second}: weights .*match the hash.*o\.json\.partial\.jsonl"):
        run_bench(plan)
    assert len(plan.partial.read_text().splitlines()) >= 3


def test_a_scene_is_the_same_alone_as_in_a_run_of_the_whole_file(tmp_path):
    """The agent draws its randomness as in episode 1, whoever ran episode 0: every action is equal to the byte."""
    names = ("coffee_can", "soup_can")
    write_random_weights(tmp_path / "w", "pantry", names)
    config = Config().with_values({"scene.names": list(names), "perception.weights": str(tmp_path / "w"),
                                   "simulator.max_steps": 4})
    plan = prepare("sceneccn", config, tmp_path / "o.json", limit=2)
    results, actions = [], {0: [], 1: []}

    def hear(topic, part, message, payload):
        if topic == RESULT:
            results.append(message)
        elif topic == ACTION:
            actions[message.episode].append(message.translation_m.tolist())

    run_local(local_pairs("sceneccn", plan.config), names, "bench", range(2), hear)
    alone = run_scene("sceneccn", plan.config.model_dump_json(), 1)
    whole = {key: getattr(results[1], key) for key in bench_module.RECORD_KEYS}
    counted = {key: alone[key] for key in Counted._fields}
    assert timeless([alone]) == [whole | {"changes": 0, "noticed": 0, "false_events": 0} | counted]
    assert counted["instances"] == 1
    assert actions[0] != actions[1]


def test_jobs_have_no_say_in_the_outcome(tmp_path):
    """The real agent, one process or two."""
    names = ("coffee_can", "soup_can")
    write_random_weights(tmp_path / "w", "pantry", names)
    config = Config().with_values({"scene.names": list(names), "perception.weights": str(tmp_path / "w"),
                                   "simulator.max_steps": 3})
    one = run_bench(prepare("sceneccn", config, tmp_path / "one.json", limit=3), jobs=1)
    two = run_bench(prepare("sceneccn", config, tmp_path / "two.json", limit=3), jobs=2)
    assert timeless(one) == timeless(two)
    assert len(one) == 3


def test_missing_weights_are_said_before_anything_runs(tmp_path):
    """One line that names the manifest."""
    config = Config().with_values({"perception.weights": str(Path(tmp_path) / "none")})
    with pytest.raises(SaccadeError, match=r"none/manifest\.json are missing: train them"):
        prepare("sceneccn", config, tmp_path / "o.json")


def test_the_commit_is_dirty_by_the_source_alone(tmp_path, monkeypatch):
    """A changed result or document says nothing about the code that ran; a changed source does."""
    def git(*arguments):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=t", "-c", "user.email=t@t", *arguments], check=True,
                       capture_output=True)

    for room in ("results", "shared"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "file").write_text("a")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path)
    (tmp_path / "results" / "file").write_text("b")
    assert re.fullmatch("[0-9a-f]{40}", provenance.commit())
    (tmp_path / "shared" / "file").write_text("b")
    assert provenance.commit().endswith("-dirty")
