"""`saccade table`: all agents side by side, resumed where it was cut, with the paper's figures below ours."""

import io
import json
import shutil
from types import SimpleNamespace

import pytest
from rich.console import Console

from saccade.app import provenance
from saccade.app.bench import comparison
from saccade.app.bench.comparison import Cell, cells, compare, core_hours
from saccade.app.bench.table import PAPER_AGENTS, PAPER_ROOM
from saccade.benchmarks.from_paper import STEPS, page, value_of
from saccade.shared.config import Config, load
from saccade.shared.errors import SaccadeError

AGENTS = ("random-walk", "still")


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    whole = comparison._configuration
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "_configuration", lambda *of: whole(*of).with_values({"simulator.max_steps": 30}))
        yield


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("table")
    compare(out, "pantry", agents=AGENTS, limit=2, console=Console(file=io.StringIO()))
    return out


def test_the_page_has_a_row_for_each_agent_and_its_pictures(written):
    page = (written / "table.md").read_text()
    assert page.count("**random-walk**") == page.count("**still**") == 1
    assert "| **still** | 2 | 0.0 % (0.0 to 65.8) |" in page
    assert "| still | nothing | not at all |" in page
    for picture in ("errors_lexa-room.png", "final_views.png"):
        assert picture in page
        assert (written / picture).stat().st_size > 5000


def test_the_time_of_all_scenes_is_told_at_the_pace_of_the_measured_ones(tmp_path, written):
    slow, fast = Cell("slow", "paper-500", tmp_path), Cell("fast", "paper-500", tmp_path)
    found = {cell: SimpleNamespace(records=[{"seconds": s} for s in seconds])
             for cell, seconds in ((slow, (20.0, 52.0)), (fast, (7.2,)))}
    assert core_hours(found, {slow: 500, fast: 100}) == pytest.approx(5.2)
    assert "all scenes of this table take 0." in (written / "table.md").read_text()


def test_what_is_there_is_not_run_again_and_more_scenes_are(written, monkeypatch):
    run = []
    real = comparison.bench
    monkeypatch.setattr(comparison, "bench", lambda plan, **how: run.append(plan.agent) or real(plan, **how))
    compare(written, "pantry", agents=AGENTS, limit=2, console=Console(file=io.StringIO()))
    assert run == []
    compare(written, "pantry", agents=("still",), limit=3, console=Console(file=io.StringIO()))
    assert run == ["still"]
    results = json.loads((written / "results" / "still_pantry_lexa-room.json").read_text())
    assert len(results["results"]) == 3


def test_results_count_wherever_their_folder_lies(written, tmp_path, monkeypatch):
    """Within the repository, too, where they name their files by the path."""
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path)
    shutil.copytree(written / "results", tmp_path / "elsewhere" / "results")
    monkeypatch.setattr(comparison, "bench", lambda *_, **__: pytest.fail("it is there"))
    compare(tmp_path / "elsewhere", "pantry", agents=AGENTS, limit=2, console=Console(file=io.StringIO()))


def test_every_agent_of_the_paper_has_its_rows(tmp_path):
    everyone = cells(tmp_path, "ycb", None)
    assert len({cell.path for cell in everyone}) == len(everyone) == 3 * 5 + 3
    assert set(comparison.PAPERS_NAMES.values()) == PAPER_AGENTS.keys()
    assert set(comparison.PAPERS_ROOM.values()) == PAPER_ROOM.keys()
    with pytest.raises(SaccadeError, match="'oracle' is not in the table"):
        cells(tmp_path, "ycb", ["oracle"])
    with pytest.raises(SaccadeError, match="'nobody' is unknown"):
        cells(tmp_path, "ycb", ["nobody"])
    with pytest.raises(SaccadeError, match="names none: choose from sceneccn, "):
        cells(tmp_path, "ycb", [])  # as of `--agents ''`: the page would have no row
    with pytest.raises(SaccadeError, match="'mugs' has no suites for the table: choose from ycb, pantry"):
        cells(tmp_path, "mugs", None)


def test_how_lexa_learns_is_drawn_from_what_its_weights_say(tmp_path):
    lines = comparison._learning("lexa", "ycb", tmp_path)
    assert "20 at each point" in lines[2]
    assert (tmp_path / "learning.png").stat().st_size > 5000


# --- from the paper's agent to ours

def test_the_steps_lead_from_the_papers_agent_to_ours_and_each_changes_something():
    ours, config = Config().model_dump(mode="json"), load(None, "paper")
    for name, keys in STEPS[1:]:
        after = config.with_values({key: value_of(ours, key) for key in keys})
        assert after != config, name
        config = after
    assert config == Config()


def test_the_change_of_a_step_is_over_the_scenes_that_both_rows_have():
    def row(successes):
        return SimpleNamespace(records=[{
            "scene": str(n), "target": "can", "success": success, "steps": 9, "declared": False, "declared_true": False,
            "azimuth_error_rad": 0.1, "elevation_error_rad": 0.1, "range_error_m": 0.1}
            for n, success in enumerate(successes)])

    last = page([("before", row([True, False, True, True])), ("after", row([True, True]))]).splitlines()[-1]
    assert last == "| after | 2 | 100.0 (34.2 to 100.0) | +50.0 ± 50.0 | 9 |"
