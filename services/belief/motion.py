"""What may have happened to one object: it rests, it drifts with constant velocity, or it is gone.

Accounts of what happened are weighed against each other (a multi-hypothesis filter; Bayesian online changepoint
detection, Adams and MacKay, 2007, with a Kalman filter for each account). At every step each account predicts what is
seen. New accounts begin at a low rate: the object now rests where it is seen, has begun to drift or to rest, or is
gone. What the probability of another account says is told as an event.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from saccade.services.belief.position import WORKSPACE_M, Evidence

Array = NDArray[np.float64]
State = Literal["rests", "drifts", "gone"]
Kind = Literal["moved", "gone", "back", "drifts", "rests"]

RATE = 0.01  # chosen: probability that something happens to an object, in a step
LEAST_OUTLIER = 0.02  # chosen: least probability that a percept is of something else
# Measured with the agent `open` on 23 scenes of the suite `moving`: an object in clear view is overlooked with this
# probability, and with the second one if it was in the image before, since successive views are alike. A presence above
# the third is as frequent of an object in clear view as of none, and tells nothing.
OVERLOOKED, OVERLOOKED_AGAIN, DOUBTFUL = 0.08, 0.2, 0.05
LOG_RATE = float(np.log(RATE))
LOG_ELSEWHERE = -float(np.log(np.diff(WORKSPACE_M).prod()))  # density of a percept of something else, anywhere
KEPT = 8  # chosen: accounts that are kept
LEAST_LOG_WEIGHT = -12.0  # chosen: accounts with less are dropped
CREEP_M = 0.002  # chosen: deviation that is added in a step, since percepts from near are better than their average
SPEED_M = 0.01  # chosen: deviation of the velocity of what begins to drift, metres a step, along x and y
ACCELERATION_M = 0.003  # chosen: deviation by which a velocity changes in a step, as on an arc
HEIGHT_M = 0.05  # chosen: deviation by which the height of a centre changes when an object is moved or falls over
TOLD = 0.9  # chosen: probability from which an event is told
VIEWS = 2  # chosen: percepts that an account must explain before it is believed
ESTABLISHED = 5.0  # chosen: log odds by its percepts that an object is there, before anything can happen to it
MOVED_M = 0.03  # chosen: nearer than this to where it was, an object was not moved
FAR = 12.0  # chosen: nor is it if the squared Mahalanobis distance is smaller
SHARED_M = 0.008  # chosen: deviation of a place that more percepts do not reduce, since their errors are alike
DRIFTED_M = 0.03  # chosen: an object drifts if it came farther than this since it began
SLOWEST_M = 0.003  # chosen: and is faster than this, metres a step


@dataclass(frozen=True)
class Account:
    """One account of an object: mean [6] and covariance [6, 6] of its position (m) and velocity (m a step), since
    which step it holds, and how many percepts it explains."""

    state: State
    since: int
    mean: Array
    covariance: Array
    log_weight: float
    views: int = 0
    overlooked: bool = False  # it was not seen in the last image that should show it
    start: Array | None = None  # where it began to drift [3]

    @property
    def place(self) -> Array:
        """Its position [3]."""
        return self.mean[:3]


class Change(NamedTuple):
    """What is now believed to have happened, and where the object is: a position [3] (m) and its covariance [3, 3]."""

    kind: Kind
    place: Array
    covariance: Array
    probability: float


class Motion:
    """The accounts of one object. `told` is the one that counts: the one by which events are told."""

    def __init__(self) -> None:
        self.accounts: list[Account] = []
        self.told: Account | None = None
        self.anchor: Account | None = None  # where it rests, or was last, as it is known best
        self.log_odds = 0.0  # that it is there, by its percepts so far

    @property
    def velocity_m(self) -> Array | None:
        """Its velocity [3], metres a step. None if it is believed to rest."""
        return self.told.mean[3:] if self.told is not None and self.told.state == "drifts" else None

    @property
    def places(self) -> Array:
        """Where the object is by each of its accounts [A, 3]."""
        return np.array([account.place for account in self.accounts]).reshape(-1, 3)

    def step(self, step: int, evidence: Evidence | None, presence: float, clear: NDArray[np.bool_]) -> Change | None:
        """Takes one image: a percept, or None if the object is not seen, and the probability that it is. `clear`
        [A] says of each account whether the object would be in clear view. Returns what is believed to have happened,
        if this is new."""
        if not self.accounts:
            if evidence is not None:
                self.log_odds, self.accounts = _log_odds(presence), [_born(step, evidence, 0.0)]
                self.told = self.anchor = self.accounts[0]
            return None
        now = [_predicted(account) for account in self.accounts]
        if evidence is None:
            clear = clear & (presence < DOUBTFUL)
            now = [_missed(account, bool(seen)) for account, seen in zip(now, clear, strict=True)]
            now += self._gone(step, now)
        else:
            self.log_odds += _log_odds(presence)
            outlier = max(1.0 - presence, LEAST_OUTLIER)
            now = [_explained(account, evidence, outlier) for account in [*now, *self._moving(step, now)]]
            level = LOG_ELSEWHERE + self._level(evidence)
            now.append(_born(step, evidence, LOG_RATE + float(np.log(1.0 - outlier)) + level))
        self.accounts = _pruned(now)
        return self._change()

    def _level(self, evidence: Evidence) -> float:
        """Log density of the height of a percept relative to any height in the workspace: what is moved stays on the
        table."""
        told = self.told
        if told is None:
            return 0.0
        variance = evidence.covariance[2, 2] + told.covariance[2, 2] + HEIGHT_M ** 2
        offset = evidence.mean[2] - told.mean[2]
        return float(-0.5 * offset ** 2 / variance - 0.5 * np.log(2 * np.pi * variance) + np.log(0.5))

    def _gone(self, step: int, now: list[Account]) -> list[Account]:
        here = max((a for a in now if a.state != "gone"), key=lambda a: a.log_weight, default=None)
        # It is taken away before this image, so the image does not speak against it.
        return [] if here is None else [Account("gone", step, here.mean, here.covariance, LOG_RATE)]

    def _moving(self, step: int, now: list[Account]) -> list[Account]:
        """What begins to drift, what comes to rest, and what turns back."""
        new = []
        here = max((a for a in now if a.state != "gone"), key=lambda a: a.log_weight, default=None)
        if here is not None and here.views >= VIEWS:
            new.append(_with_velocity(here, "drifts", step, np.zeros(3), SPEED_M))
        drifts = max((a for a in now if a.state == "drifts"), key=lambda a: a.log_weight, default=None)
        if drifts is not None and drifts.views >= VIEWS:
            new.append(_with_velocity(drifts, "drifts", step, -drifts.mean[3:], ACCELERATION_M))
            new.append(_with_velocity(drifts, "rests", step, np.zeros(3), 0.0))
        return new

    def _change(self) -> Change | None:
        told = self.told
        if told is None or self.anchor is None or self.log_odds < ESTABLISHED:
            self.told = self.anchor = max(self.accounts, key=lambda a: a.log_weight)
            if self.told.state == "gone":  # what was not sure to be there need not have gone
                self.accounts, self.log_odds = [], 0.0
            return None
        found: list[tuple[Kind, list[Account]]] = [
            ("gone", [a for a in self.accounts if a.state == "gone"] if told.state != "gone" else []),
            ("drifts", [a for a in self.accounts if _drifts(a)] if told.state == "rests" else []),
            ("rests", [a for a in self.accounts if a.state == "rests" and a.views >= VIEWS]
             if told.state == "drifts" else []),
            ("back", [a for a in self.accounts if a.state != "gone" and a.views >= VIEWS]
             if told.state == "gone" else []),
            ("moved", [a for a in self.accounts if a.state == "rests" and a.views >= VIEWS and _far(a, self.anchor)]
             if told.state == "rests" else [])]
        for kind, accounts in found:
            probability = float(sum(np.exp(a.log_weight) for a in accounts))
            if probability > TOLD:
                return self._tell(kind, max(accounts, key=lambda a: a.log_weight), probability)
        likeliest = max(self.accounts, key=lambda a: a.log_weight)
        if likeliest.state == told.state:
            self.told = likeliest
            if likeliest.state == "rests" and not _far(likeliest, self.anchor) and _spread(likeliest) < _spread(
                    self.anchor):
                self.anchor = likeliest
        return None

    def _tell(self, kind: Kind, account: Account, probability: float) -> Change:
        self.told = account
        if kind == "back" and self.anchor is not None and _far(account, self.anchor):
            kind = "moved"
        if kind in ("moved", "back", "rests"):
            self.anchor = account
        return Change(kind, account.place, account.covariance[:3, :3], min(probability, 1.0))


def _born(step: int, evidence: Evidence, log_weight: float) -> Account:
    """An object that rests where it is seen."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = evidence.covariance
    return Account("rests", step, np.concatenate([evidence.mean, np.zeros(3)]), covariance, log_weight, views=1)


def _with_velocity(account: Account, state: State, step: int, velocity_m: Array, deviation_m: float) -> Account:
    """What begins with this step, from where the object is by an account: another velocity [3] (m a step)."""
    mean, covariance = account.mean.copy(), account.covariance.copy()
    mean[3:], covariance[3:], covariance[:, 3:] = velocity_m, 0.0, 0.0
    covariance += np.diag([deviation_m ** 2, deviation_m ** 2, 0.0] * 2)
    return replace(account, state=state, since=step, mean=mean, covariance=covariance, views=0,
                   start=account.place if state == "drifts" else None, log_weight=account.log_weight + LOG_RATE)


def _predicted(account: Account) -> Account:
    """The account one step later."""
    if account.state == "gone":
        return account
    noise = np.diag([CREEP_M ** 2] * 3 + [0.0] * 3)
    if account.state == "rests":
        return replace(account, covariance=account.covariance + noise)
    move = np.eye(6)
    move[:3, 3:] = np.eye(3)
    noise[3, 3] = noise[4, 4] = ACCELERATION_M ** 2
    return replace(account, mean=move @ account.mean, covariance=move @ account.covariance @ move.T + noise)


def _missed(account: Account, clear: bool) -> Account:
    if account.state == "gone" or not clear:
        return account
    probability = OVERLOOKED_AGAIN if account.overlooked else OVERLOOKED
    return replace(account, log_weight=account.log_weight + np.log(probability), overlooked=True)


def _explained(account: Account, evidence: Evidence, outlier_share: float) -> Account:
    """The account after a percept: a Kalman filter's update, with the density that it gave the percept. This is of
    something else with the probability `outlier_share`."""
    outlier = float(np.log(outlier_share)) + LOG_ELSEWHERE
    if account.state == "gone":
        return replace(account, log_weight=account.log_weight + outlier)
    spread = account.covariance[:3, :3] + evidence.covariance
    offset = evidence.mean - account.place
    inverse = np.linalg.inv(spread)
    log_density = -0.5 * (offset @ inverse @ offset + np.linalg.slogdet(2 * np.pi * spread)[1])
    inlier = float(np.log(1.0 - outlier_share)) + log_density
    weight = account.log_weight + float(np.logaddexp(inlier, outlier))
    if inlier < outlier:
        return replace(account, log_weight=weight)
    gain = account.covariance[:, :3] @ inverse
    return replace(account, mean=account.mean + gain @ offset, log_weight=weight, views=account.views + 1,
                   overlooked=False,
                   covariance=account.covariance - gain @ account.covariance[:3])


def _log_odds(presence: float) -> float:
    return float(np.log(presence / max(1.0 - presence, 1e-3)))


def _pruned(accounts: list[Account]) -> list[Account]:
    """The likeliest accounts. Their weights sum to 1."""
    total = float(np.logaddexp.reduce([a.log_weight for a in accounts]))
    accounts = sorted((replace(a, log_weight=a.log_weight - total) for a in accounts), key=lambda a: -a.log_weight)
    kept = [a for a in accounts if a.log_weight > LEAST_LOG_WEIGHT]
    # Of an object that is gone there is nothing more to tell, so one account of that is enough.
    gone = next((a for a in kept if a.state == "gone"), None)
    return [a for a in kept if a.state != "gone" or a is gone][:KEPT]


def _far(one: Account, other: Account) -> bool:
    """Whether two accounts place the object differently."""
    offset = one.place - other.place
    spread = one.covariance[:3, :3] + other.covariance[:3, :3] + np.eye(3) * (2 * SHARED_M ** 2)
    return bool(np.linalg.norm(offset) > MOVED_M and offset @ np.linalg.solve(spread, offset) > FAR)


def _spread(account: Account) -> float:
    return float(np.trace(account.covariance[:3, :3]))


def _drifts(account: Account) -> bool:
    """Whether an account says that the object has drifted noticeably."""
    return (account.state == "drifts" and account.views >= VIEWS and account.start is not None
            and bool(np.linalg.norm(account.place - account.start) > DRIFTED_M)
            and bool(np.linalg.norm(account.mean[3:]) > SLOWEST_M))
