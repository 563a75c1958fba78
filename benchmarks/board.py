"""`python -m saccade.benchmarks.board [OUT]` measures the camera's poses from a printed board, in a rehearsal.

MuJoCo films the board from many sides at about 0.5 m (see `board_scene.py`). The same films are judged with the lens
that `saccade calibrate` finds in another rendered film, with the true lens, and with focal lengths that are wrong by
2 %. `OUT` is the file of the results, by default results/benchmarks/board.json.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from saccade.app.camera.calibrate import calibrate
from saccade.benchmarks.board_scene import BOARD, LENS, RATE_HZ, SIZE, Hand, Scene, clip, encode, wrong_by
from saccade.services.camera.board_poses import BoardPoses
from saccade.services.camera.calibration import read_calibration
from saccade.services.camera.charuco import Corners, Finder
from saccade.services.camera.sources import Video
from saccade.services.camera.trajectories.lens import Lens
from saccade.shared.log.provenance import commit
from saccade.shared.world.geometry import rotation_angle

CLIPS, FRAMES, SEED = 10, 24, 7
CALIBRATION_CLIPS, CALIBRATION_FRAMES = 30, 1  # many short looks, as somebody who holds the camera still now and then


class Found(NamedTuple):
    """A film, the hand that held the camera, and for each image the corners that were found and its time in seconds."""

    path: Path
    hand: Hand
    images: list[tuple[Corners, float]]


def film(folder: Path, clips: int = CLIPS, frames: int = FRAMES) -> list[tuple[Path, Hand]]:
    """Renders films of the board into a folder. Returns each with the hand that held the camera."""
    scene, films = Scene(), []
    for k in range(clips):
        rng = np.random.default_rng((SEED, k))
        hand = Hand(rng)
        encode(clip(scene, hand, frames, rng), folder / f"{k}.mp4")
        films.append((folder / f"{k}.mp4", hand))
    scene.close()
    return films


def calibrated(folder: Path) -> tuple[Lens, list[str]]:
    """Films the board for a calibration, and finds the lens with `saccade calibrate`. Returns what it says, too."""
    scene, rng = Scene(), np.random.default_rng(SEED)
    hands = [Hand(rng, range_m=(0.28, 0.5), elevation_rad=(0.7, 1.4), gaze_m=0.09, rolls_rad=3.0)
             for _ in range(CALIBRATION_CLIPS)]
    images = [scene.seen(hand.exposure(0.0), rng) for hand in hands]
    scene.close()
    encode((image for image in images for _ in range(int(0.25 * RATE_HZ))), folder / "calibration.mp4")
    (folder / "board.json").write_text(json.dumps(BOARD.model_dump(mode="json")))
    told = list(calibrate(str(folder / "calibration.mp4"), folder / "board.json", "pinhole", folder / "camera.toml",
                          Console(quiet=True)))
    return read_calibration(str(folder / "camera.toml")).lens, told


def found_in(films: list[tuple[Path, Hand]]) -> list[Found]:
    """Looks for the board in all images of the films."""
    finder = Finder(BOARD)
    return [Found(path, hand, [(finder.find(image.rgb), image.time_s) for image in Video(path)])
            for path, hand in films]


def judge(films: list[Found], lens: Lens, *, smooth: bool = True) -> dict[str, Any]:
    """Compares the poses of all images of the films with the true ones."""
    apart_mm, apart_deg, why, count = [], [], Counter[str](), 0
    for path, hand, images in films:
        poses = BoardPoses(BOARD, lens.at(SIZE), path, smooth=smooth)
        for k, (corners, time_s) in enumerate(images):
            count += 1
            found, true = poses.from_corners(corners, time_s), hand.at(k / RATE_HZ)
            if found is not None:
                apart_mm.append(1e3 * float(np.linalg.norm(found[:3, 3] - true[:3, 3])))
                apart_deg.append(float(np.degrees(rotation_angle(found[:3, :3], true[:3, :3]))))
        why += poses.why_not
    return {"images": count, "without_pose": round(1 - len(apart_mm) / count, 4), "why": dict(why.most_common()),
            "position_mm": _spread(apart_mm), "rotation_deg": _spread(apart_deg),
            "beyond_5_mm_or_half_a_degree": int(((np.array(apart_mm) > 5) | (np.array(apart_deg) > 0.5)).sum()),
            "beyond_2_cm": int((np.array(apart_mm) > 20).sum())}


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 3), "95 %": round(float(np.percentile(values, 95)), 3),
            "maximum": round(float(np.max(values)), 3)}


def main(out: Path) -> None:
    """Prints the results, and writes them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lens, told = calibrated(folder)
        films = found_in(film(folder))
        results = {"commit": commit(), "calibration": [*told[:-1]],
                   "true_lens": {"intrinsics_px": LENS.intrinsics_px, "distortion": dict(LENS.distortion)},
                   "with the calibration": judge(films, lens), "with the true lens": judge(films, LENS),
                   "each image by itself": judge(films, lens, smooth=False),
                   "focal lengths 2 % too long": judge(films, wrong_by(0.02)),
                   "focal lengths 2 % too short": judge(films, wrong_by(-0.02))}
    text = json.dumps(results, indent=1)
    print(text)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/benchmarks/board.json"))
