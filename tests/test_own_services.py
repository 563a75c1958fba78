"""Services from outside the package: on the bus, in one process, in bench and in replay; what is none is told."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
from rich.console import Console

import saccade
from saccade.app.bench.bench import bench, prepare
from saccade.app.run.run import run
from saccade.shared.config import PACKAGE, Config
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.modules import load
from saccade.tests.fakes.logs import logged

GREEDY = {"services.planner": "greedy_planner"}
EPISODE = {"scene.names": ["soup_can", "rice_box"], "scene.n_objects": 2, "simulator.max_steps": 8,
           "scene.explore": True, "seed": 4}
HEADER = """
from saccade.shared.bus.topics import ACTION, BELIEF, FRAME, GOAL, PLAN, RESULT, TRUTH
from saccade.shared.loop.service import Service
"""
SOURCE = HEADER + """
from saccade.services.simulator.core import Simulator, build as build_simulator

SERVICE = Service("simulator", inputs=(ACTION,), trigger=ACTION, outputs=(FRAME, GOAL, TRUTH), closed_by=RESULT)

def build(config):
    print("a source of my own", flush=True)
    return build_simulator(config)
"""


@pytest.fixture(autouse=True)
def importable(monkeypatch, tmp_path):
    """As with PYTHONPATH=examples, here and in the processes that are started."""
    for folder in (tmp_path, PACKAGE / "examples"):
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", f"{PACKAGE / 'examples'}:{tmp_path}")


def code_of(page: str, title: str) -> str:
    """The program with this title on a page of the guide."""
    return (PACKAGE / "docs" / page).read_text().partition(f'title="{title}"\n')[2].partition("\n```")[0] + "\n"


def test_a_planner_of_ones_own_runs_on_the_bus_and_in_one_process_alike(tmp_path):
    logs = {}
    for kind in ("zenoh", "local"):
        config = Config().with_values(EPISODE | GREEDY | {"bus.kind": kind})
        out = tmp_path / kind / "same"
        run(config, agent="sceneccn", out=out, plain=True, console=Console(file=io.StringIO()))
        logs[kind] = logged(out / "run.mcap")
    assert logs["zenoh"] == logs["local"]
    steps = [step for episode in saccade.open(out) for step in episode if step.plan is not None]
    assert len(steps) == 8
    for step in steps:
        vague = max(step.beliefs.values(), key=lambda belief: np.trace(belief.covariance_m2))
        assert np.array_equal(step.plan.look_at_m, vague.mean_m)  # it is that planner


@pytest.mark.parametrize("slot", ["planner", "perception", "belief"])
@pytest.mark.parametrize("explore", [True, False])
def test_the_services_of_the_guide_run_on_the_bus_and_in_one_process_alike(tmp_path, slot, explore):
    (tmp_path / "my_package").mkdir()
    name = f"my_package/my_{slot}"
    (tmp_path / f"{name}.py").write_text(code_of("service.md", f"{name}.py"))
    logs = {}
    for kind in ("zenoh", "local"):
        config = Config().with_values(EPISODE | {f"services.{slot}": name.replace("/", "."), "bus.kind": kind,
                                                 "simulator.max_steps": 3, "scene.explore": explore})
        run(config, agent="sceneccn", out=tmp_path / kind / "same", plain=True, console=Console(file=io.StringIO()))
        logs[kind] = logged(tmp_path / kind / "same" / "run.mcap")
    assert logs["zenoh"] == logs["local"]
    counts = {topic: len(messages) for (topic, part), messages in logs["local"].items() if part in (None, "rice_box")}
    events = {} if slot == "belief" else {"events": 3}  # a belief of one's own may leave them out
    assert counts == {"frame": 3, "goal": 1, "truth": 4, "goal_percept": 1, "percept": 3, "belief": 3, "plan": 3,
                      "action": 3, "result": 1} | events


def test_it_is_measured_and_replayed(tmp_path):
    config = Config().with_values({"scene.names": ["soup_can"], "simulator.max_steps": 3} | GREEDY)
    plan = prepare("sceneccn", config, tmp_path / "greedy.json", limit=1)
    bench(plan, jobs=1, command="saccade bench", console=Console(file=io.StringIO()))
    told = json.loads((tmp_path / "greedy.json").read_text())
    assert told["config"]["services"]["planner"] == "greedy_planner"
    golden = PACKAGE / "tests" / "fixtures" / "golden.mcap"
    done = subprocess.run([sys.executable, "-m", "saccade", "replay", str(golden), "--into", "planner", "--out",
                           str(tmp_path / "replay"), "--set", "services.planner=greedy_planner"],
                          capture_output=True, text=True, check=True)
    assert "8 answers compared, 8 differ in a byte" in done.stdout
    steps = [step for episode in saccade.open(tmp_path / "replay") for step in episode]
    assert {step.plan.candidates for step in steps} == {1}


def test_a_source_of_ones_own_stands_in_the_simulators_place(tmp_path):
    (tmp_path / "my_source.py").write_text(SOURCE)
    config = Config().with_values(EPISODE | {"services.source": "my_source", "simulator.max_steps": 3})
    finished = run(config, agent="sceneccn", out=tmp_path / "r", plain=True, console=Console(file=io.StringIO()))
    assert finished.results[0].steps == 3
    assert "a source of my own" in (tmp_path / "r" / "logs" / "simulator.log").read_text()


@pytest.mark.parametrize(("text", "words"), [
    (None, r"module 'mine' cannot be imported \(No module named 'mine'\): install it"),
    ("import nothing_like_it", r"cannot be imported \(No module named 'nothing_like_it', in \S+/mine.py, line 1\): "
                               "install nothing_like_it, or repair it"),
    ("\n1 / 0", r"cannot be imported \(division by zero, in \S+/mine.py, line 2\): repair it"),
    ("def:", r"cannot be imported \(invalid syntax, in \S+/mine.py, line 1\): repair it"),
    ("from saccade.shared.bus.topics import NOWHERE", r"'NOWHERE' .*mine.py, line 1\): repair it"),
    ("", "declares no SERVICE"),
    ("SERVICE = 'planner'", "declares no SERVICE"),
    (HEADER + "SERVICE = Service('planner', (BELIEF,), BELIEF, (PLAN, ACTION))", r"has no build\(config\)"),
    (HEADER + "SERVICE = Service('mine', (BELIEF,), BELIEF, (PLAN, ACTION))\nbuild = print",
     "calls itself 'mine': it stands in the place of 'planner'"),
    (HEADER + "SERVICE = Service('planner', (BELIEF,), BELIEF, (PLAN,))\nbuild = print",
     "declares the outputs plan: the planner has action, plan"),
    (HEADER + "SERVICE = Service('planner', (BELIEF,), FRAME, (PLAN, ACTION))\nbuild = print",
     "declares the trigger frame, which is none of its inputs belief"),
    (HEADER + "SERVICE = Service('planner', (BELIEF,), BELIEF, (PLAN, ACTION), closed_by=RESULT)\nbuild = print",
     "must declare closed_by None"),
])
def test_a_module_that_is_no_service_gets_one_line(tmp_path, monkeypatch, text, words):
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    with pytest.raises(SaccadeError, match=rf"^services\.planner: .*{words}") as caught:
        run(Config().with_values({"services.planner": "mine"}), agent="sceneccn", out=tmp_path / "r", plain=True)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("bus", ["zenoh", "local"])
@pytest.mark.parametrize(("made", "words"), [
    ("None", "services.planner: module 'mine': build(config) returns NoneType, which has no method begin and no method "
             "step: return a core"),
    ("Wrong()", "planner gives an invalid action: translation_m: not finite; the run cannot go on without it"),
])
def test_a_core_that_is_none_or_says_nonsense_gets_one_line(tmp_path, bus, made, words):
    text = code_of("service.md", "my_package/my_planner.py").replace("np.zeros(3), rot", "np.full(3, np.nan), rot")
    (tmp_path / "mine.py").write_text(text.replace("MyPlanner(config)", made.replace("Wrong()", "MyPlanner(config)")))
    done = subprocess.run([sys.executable, "-m", "saccade", "run", "--plain", "--explore", "--names", "soup_can",
                           "--bus", bus, "--set", "services.planner=mine", "--out", tmp_path / "r"],
                          capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_what_says_nonsense_in_a_replay_gets_one_line(tmp_path):
    text = code_of("service.md", "my_package/my_planner.py").replace("np.zeros(3), rot", "np.full(3, np.nan), rot")
    (tmp_path / "mine.py").write_text(text)
    golden = PACKAGE / "tests" / "fixtures" / "golden.mcap"
    done = subprocess.run([sys.executable, "-m", "saccade", "replay", golden, "--into", "planner", "--bus", "local",
                           "--set", "services.planner=mine", "--out", tmp_path / "r"],
                          capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (
        2, "saccade: planner gives an invalid action: translation_m: not finite\n")


def test_without_a_word_all_services_are_ours():
    for name in ("simulator", "camera", "perception", "belief", "planner", "evaluator"):
        assert load(name, Config()).service.name == name


def test_a_client_without_saccade_reads_frames_and_beliefs(tmp_path):
    """`examples/listen.py` beside a run; it imports nothing of ours."""
    source = (PACKAGE / "examples" / "listen.py").read_text()
    assert "import saccade" not in source
    assert "from saccade" not in source
    from saccade.shared.bus.transport import free_endpoint

    endpoint = free_endpoint("tcp/127.0.0.1:0")
    config = Config().with_values(EPISODE | {"bus.endpoint": endpoint, "simulator.max_steps": 200})
    config.save(tmp_path / "config.json")
    with closing_process([sys.executable, "-m", "saccade", "run", "--config", tmp_path / "config.json", "--plain",
                          "--out", tmp_path / "r"]) as runs:
        for line in runs.stdout:
            if "step 0" in line:
                break
        done = subprocess.run([sys.executable, PACKAGE / "examples" / "listen.py", endpoint, "6"], capture_output=True,
                              text=True, check=True, timeout=60)
    assert "image (480, 480, 3), camera at [" in done.stdout
    assert "saccade/table/belief/soup_can step" in done.stdout
    assert len(done.stdout.splitlines()) == 6


def closing_process(command):
    """A process that is ended when the context is left."""
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)

    class Ending:
        stdout = process.stdout

        def close(self):
            process.terminate()
            process.wait(30)
            process.stdout.close()

    return closing(Ending())
