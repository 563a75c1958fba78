"""Says in words how a run ended."""

from __future__ import annotations

from saccade.app.run.display import Progress, each_of, spread_cm
from saccade.shared.bus.messages import Result
from saccade.shared.config import Config


def summary(config: Config, results: list[Result], progress: Progress) -> list[str]:
    """Returns lines that say how a run ended: its results, what the agent itself says, and what it found."""
    lines = [_result_line(config, result) for result in results]
    if config.camera.source is not None:
        lines += _camera_lines(config, progress)
    lines += _doubts(config, progress)
    if config.scene.explore:
        for belief in each_of(progress.beliefs):
            if belief.presence <= 0.5:
                continue
            where = ", ".join(f"{x:.3f}" for x in belief.mean_m)
            lines.append(f"found {belief.label()} at ({where}) m ± {spread_cm(belief):.1f} cm")
        for name, kind in sorted(progress.beliefs.items()):
            count, probability = kind.count()
            if kind.further:
                lines.append(f"there are {count} of {name} (probability {probability:.2f})")
    elif len(results) > 1 and config.scene.goal_image is None:
        lines.append(f"reached {sum(r.success for r in results)} of {len(results)} goals")
    return lines


def _doubts(config: Config, progress: Progress) -> list[str]:
    """What the agent itself says, after the last episode, about why there was nothing to reach."""
    plan = progress.plan
    if plan is None or config.scene.explore:
        return []
    if not plan.target and not progress.beliefs:
        return []  # it knows no objects, and so it looked for none in the goal image
    if not plan.target:
        return [f"the goal image shows none of the known objects (confidence {plan.goal_confidence:.2f}): the agent "
                "explored instead"]
    target = progress.beliefs.get(plan.target)
    if target is not None and target.presence < 0.5:
        return [f"{plan.target} was not found: believed not to be there (presence {target.presence:.2f})"]
    return []


def _result_line(config: Config, result: Result) -> str:
    """How one episode ended. It gives errors only if the goal's true view is known."""
    if config.scene.explore:
        return f"{result.scene}: explored for {result.steps} steps"
    if config.scene.goal_image is not None:
        said = f"says after {result.steps} steps that it is there" if result.declared else \
            f"did not find the goal's view in {result.steps} steps"
        return f"goal image {config.scene.goal_image.name}: the agent {said}"
    reached = "reached the goal" if result.success else "did not reach the goal"
    return (f"{result.scene}: {reached} in {result.steps} steps; errors: azimuth {result.azimuth_error_rad:.3f} rad, "
            f"elevation {result.elevation_error_rad:.3f} rad, range {result.range_error_m:.3f} m")


def unusable_line(count: int) -> str:
    """Says how many messages of the camera's source could not be used."""
    return f"{count} message{' that cannot be used was' if count == 1 else 's that cannot be used were'} left out"


def _camera_lines(config: Config, progress: Progress) -> list[str]:
    """What was seen, and what the agent says about the goal. A real camera has no truth with which this could be
    judged."""
    views = 0 if progress.at is None else progress.at[1] + 1
    skipped = {name: status.skipped for name, status in sorted(progress.statuses.items()) if status.skipped}
    without_pose = skipped.pop("camera", 0)
    told = [f"{views} view{'' if views == 1 else 's'}"]
    if without_pose:
        told.append(f"{without_pose} images without a pose were left out")
    if "camera" in progress.statuses and (unusable := progress.statuses["camera"].refused):
        told.append(unusable_line(unusable))
    lines = ["; ".join(told + [f"{name} skipped {count}" for name, count in skipped.items()])]
    goal_image = config.scene.goal_image
    if config.scene.explore or goal_image is None:
        return lines
    said = "does not say that it is there"
    if progress.declared is not None:
        said = f"says at view {progress.declared.step} that it is there"
    elif progress.plan is not None and progress.believed_distance_m is not None:
        where = ", ".join(f"{x:.2f}" for x in progress.plan.viewpoint[:3, 3])
        said += f"; it would move to ({where}) m"
    return [*lines, f"goal image {goal_image.name}: the agent {said}"]
