"""Work on many scenes in processes that share nothing: on this machine with joblib, on a cluster with Ray."""

from __future__ import annotations

import functools
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from saccade.app.run.threads import VARIABLES, enforce_one_thread
from saccade.shared.errors import SaccadeError

ORPHANED_S = 1.0

Work = Mapping[str, tuple]
Results = Iterator[tuple[str, Any]]


def in_processes(function: Callable[..., Any], work: Work, jobs: int, cluster: str | None = None) -> Results:
    """Yields (scene, function(*arguments)) for the scenes in `work`, as they become ready. On this machine `jobs` of
    them run at a time. On a Ray cluster, whose address is `cluster` (`ray://host:10001`), as many run as it has cores.
    Its nodes need the same checkout in the same place.

    The function and what it returns must be picklable. An interruption ends all processes. Raises SaccadeError, which
    names the scene, if a scene cannot be worked on, and also if a process has died.
    """
    if not work:
        return
    enforce_one_thread()
    yield from _on_ray(function, work, cluster) if cluster else _here(function, work, jobs)


def _named(function: Callable[..., Any], scene: str, arguments: tuple) -> tuple[str, Any]:
    try:
        return scene, function(*arguments)
    except SaccadeError as error:
        raise SaccadeError(f"scene {scene}: {error}") from None


def _here(function: Callable[..., Any], work: Work, jobs: int) -> Results:
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    parallel = Parallel(n_jobs=min(jobs, len(work)), backend="loky", batch_size=1, return_as="generator_unordered",
                        initializer=_follow_the_parent)
    warnings.filterwarnings("ignore", "[0-9]+ tasks (which were still being|have been)", UserWarning)  # after Ctrl-C
    try:
        yield from parallel(delayed(_named)(function, scene, arguments) for scene, arguments in work.items())
    except TerminatedWorkerError as error:
        raise SaccadeError("one of the processes has died, perhaps for lack of memory: give the same command again, "
                           "with fewer --jobs") from error
    finally:
        get_reusable_executor().shutdown(wait=False, kill_workers=True)


def _follow_the_parent() -> None:
    """Makes a worker leave Ctrl-C to its parent, and end when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ORPHANED_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _again(join: Callable[[], Any], attempts: int = 3) -> None:
    """Joins a cluster which is there, but was too slow, or whose process for us died at its start."""
    for _ in range(attempts - 1):
        try:
            join()
            return
        except ConnectionAbortedError:
            continue
    join()


def _on_ray(function: Callable[..., Any], work: Work, cluster: str) -> Results:
    try:
        import ray
    except ImportError as error:
        raise SaccadeError("--cluster needs Ray: pip install 'saccade[cluster]'") from error
    names = [name for name in ("MUJOCO_GL", "SACCADE_YCB") if name in os.environ]
    environment = dict.fromkeys(VARIABLES, "1") | {name: os.environ[name] for name in names}
    join = functools.partial(ray.init, cluster, log_to_driver=False, logging_level=logging.ERROR,
                             runtime_env={"env_vars": environment})
    try:
        _again(join)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise SaccadeError(f"no Ray cluster answers at {cluster}: {str(error).strip().splitlines()[-1]}") from error
    try:
        task = ray.remote(max_retries=2)(_named)
        waiting = [task.remote(function, scene, arguments) for scene, arguments in work.items()]
        while waiting:
            (ready,), waiting = ray.wait(waiting)
            yield ray.get(ready)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, SaccadeError):
            raise error.cause from error
        raise
    except ray.exceptions.RayError as error:
        raise SaccadeError(f"the Ray cluster at {cluster} gave up: {str(error).splitlines()[0]}") from error
    finally:
        ray.shutdown()
