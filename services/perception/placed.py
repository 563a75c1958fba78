"""Where an object is that was found, and how it is turned, in the camera's frame."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from saccade.services.perception.comparer import Compared
from saccade.services.perception.likeness import sure_of
from saccade.services.perception.seen import Modes
from saccade.services.perception.things import Match, Things
from saccade.shared.model.bank import FILLED, Bank
from saccade.shared.world.geometry import pixel_rays, project, rotation_towards, unit
from saccade.shared.world.windows import upright

MODES = 24  # likeliest views of an object that are told
CAP_RAD = 0.35  # views within this of a compared one are told as one, where the comparison says
VIEW_STD_RAD = 0.12  # of a direction that is told by a view alone: about half of the way to the next one
FITTED_PX, FITTED_LOG_SCALE, FITTED_RAD = 2.0, 0.03, 0.05  # standard deviations of a pose that landmarks tell

Array = NDArray[np.float64]


class Placed:
    """Where an object is that was found: its ray in the camera's frame [3], its range, and how it may be turned."""

    def __init__(self, bank: Bank, match: Match, compared: Compared, things: Things, intrinsics_px: ArrayLike,
                 up: ArrayLike):
        self.bank, self.compared, self.up = bank, compared, np.asarray(up, dtype=np.float64)
        row, window = match.row, things.window
        half, as_cut = float(window.half_tangent[match.thing]), float(things.roll[match.thing])
        self.roll = float(compared.roll[row]) - as_cut
        right, down, radius_m = bank.circles_m[match.view]
        self.range_m = radius_m / (half * FILLED * float(compared.log_ratio[row].exp()))
        aside = turn_of(self.roll) @ np.array([right, down]) / self.range_m
        tangent = turn_of(-as_cut) @ compared.shift[row].double().numpy() * half - aside
        rotation = upright(pixel_rays(window.pixels[match.thing, None], intrinsics_px), self.up)[0]
        self.ray = unit(rotation @ np.array([tangent[0], -tangent[1], -1.0]))
        self.pixel = project(self.ray, np.eye(4), intrinsics_px)[0]
        shift_std, self.log_scale_std = compared.deviation[row, :2].tolist()
        self.pixel_std = float(shift_std * half * np.asarray(intrinsics_px)[0])
        self.sure, self.fitted = 0.0, np.eye(3)
        if match.fit is not None:
            self.sure = float(sure_of(torch.tensor(match.fit.support)))
            turn = np.eye(3)
            turn[:2, :2] = turn_of(-as_cut).T
            camera = rotation @ turn
            self.fitted = camera @ match.fit.camera_from_object[:3, :3]
            if self.sure > 0.5:
                center = camera @ match.fit.camera_from_object[:3, 3]
                self.range_m, self.ray = float(np.linalg.norm(center)), unit(center)
                self.pixel = project(self.ray, np.eye(4), intrinsics_px)[0]
                self.pixel_std, self.log_scale_std = FITTED_PX, FITTED_LOG_SCALE

    def modes(self, similar: Tensor, compared: list[tuple[int, int]], sharpness: float) -> Modes:
        """How the object may be turned, by the similarities [V] to its views, of which some were `compared` (view,
        row): around these the direction is known better."""
        directions = self.bank.directions
        share = (sharpness * (similar - similar.max())).double().exp().numpy()
        rows = [row for _, row in compared]
        near = np.argmax(directions @ directions[[view for view, _ in compared]].T, axis=1)
        share = share * self.compared.same[rows].sigmoid().double().numpy()[near]
        towards: list[Array] = []
        weights: list[float] = []
        for view, row in compared:
            cap = directions @ directions[view] > np.cos(CAP_RAD)
            towards.append(turned(directions[view], self.compared.turn[row].double().numpy()))
            weights.append(float(share[cap].sum()))
            share = np.where(cap, 0.0, share)
        rest = np.argsort(-share)[:MODES - len(compared)]
        deviation = np.concatenate([self.compared.deviation[rows, 2], np.full(len(rest), VIEW_STD_RAD)])
        weight = np.maximum(np.concatenate([weights, share[rest]]), 1e-12)
        order = np.argsort(-weight)
        camera = upright(self.ray[None], self.up)[0]
        roll = np.eye(3)
        roll[:2, :2] = turn_of(self.roll).T
        all_towards = np.concatenate([towards, directions[rest]])[order]
        rotations = camera @ roll @ rotation_towards(-all_towards).transpose(0, 2, 1)
        return self._with_fit(rotations, weight[order] / weight.sum(), deviation[order])

    def _with_fit(self, rotations: Array, weight: Array, deviation: Array) -> Modes:
        """How the object may be turned, where its landmarks may say it, too."""
        if self.sure == 0.0:
            return Modes(rotations, np.log(weight), deviation)
        weight = np.maximum(np.append(weight * (1.0 - self.sure), self.sure), 1e-12)
        order = np.argsort(-weight)
        return Modes(np.concatenate([rotations, self.fitted[None]])[order], np.log(weight / weight.sum())[order],
                     np.append(deviation, FITTED_RAD)[order])


def turned(known: Array, turn: Array) -> Array:
    """The direction [3] that lies an angle to the right and one up [2] (rad) from the direction `known` [3], as its
    camera sees its own motion."""
    angle = float(np.linalg.norm(turn))
    flat = turn * (np.sin(angle) / max(angle, 1e-9))
    return rotation_towards(-known) @ np.array([flat[0], flat[1], np.cos(angle)])


def turn_of(angle: float) -> Array:
    """The rotation [2, 2] of a picture (right, down) by an angle (rad)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
