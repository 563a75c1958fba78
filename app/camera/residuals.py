"""Draws what a calibration leaves unexplained: at each corner that was found, and for each view."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from saccade.app.camera.solving import Solved
from saccade.app.look.picture import new_figure, save

INCHES, DPI = (12.0, 5.2), 100
SHOWN = 0.05  # of the image's width: how long the arrow of a usual residual is drawn


def draw_residuals(solved: Solved, out: Path) -> None:
    """Draws the residuals of a calibration as a picture. Raises SaccadeError if it cannot be written."""
    figure = new_figure(INCHES, DPI)
    places, views = figure.subplots(1, 2, width_ratios=(1.5, 1))
    width, height = solved.calibration.size_px
    pixels = np.concatenate([view.corners.pixels for view in solved.views])
    rest = np.concatenate(solved.residuals)
    rms_px = max(solved.calibration.rms_px or 0.0, 1e-6)
    enlarged = SHOWN * width / (2 * rms_px)
    arrows = places.quiver(*pixels.T, *rest.T, np.linalg.norm(rest, axis=1), angles="xy", scale_units="xy",
                           scale=1 / enlarged, width=0.0015, cmap="viridis")
    figure.colorbar(arrows, ax=places, label="pixels")
    places.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u (px)", ylabel="v (px)",
               title=f"residuals, drawn {enlarged:.0f} times as long: they should point anywhere")
    errors = [float(np.sqrt((one ** 2).sum(1).mean())) for one in solved.residuals]
    views.barh(range(len(errors)), errors, color="#00798c")
    views.axvline(rms_px, color="#d1495b", label=f"all: {rms_px:.2f}")
    views.set(yticks=range(len(errors)), yticklabels=[view.name[-24:].replace("$", r"\$") for view in solved.views],
              xlabel="rms (px)", title="each view")
    views.tick_params(axis="y", labelsize=6)
    views.invert_yaxis()
    views.legend(frameon=False)
    figure.suptitle(f"{solved.calibration.model} calibration from {len(errors)} views: {rms_px:.2f} pixels rms")
    save(figure, out)
