"""The benchmark of the board in small: MuJoCo films it with a distorting lens, blur, noise and H.264."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")
pytest.importorskip("av")

from saccade.benchmarks.board import film, found_in, judge
from saccade.benchmarks.board_scene import LENS, wrong_by


def test_poses_from_a_film_of_the_board_are_right(tmp_path):
    films = found_in(film(tmp_path, clips=2, frames=5))
    found = judge(films, LENS)
    assert (found["images"], found["beyond_2_cm"]) == (10, 0)
    assert found["without_pose"] <= 0.5
    assert found["position_mm"]["median"] < 5
    assert found["rotation_deg"]["median"] < 0.5
    wrong = judge(films, wrong_by(0.02))
    assert wrong["beyond_2_cm"] == 0
    assert wrong["position_mm"]["median"] > 5  # a focal length that is 2 % too long puts the camera 1 cm too far away
