"""Work on many scenes in processes that share nothing; an interruption ends them all."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from deploy.threads import enforce_one_thread
from shared.errors import SaccadeError


def in_processes(function: Callable[..., Any], work: Mapping[str, tuple], jobs: int) -> Iterator[tuple[str, Any]]:
    """(scene, function(*arguments)) as they are ready, for the scenes in `work`, `jobs` at a time.

    The function and what it returns must be picklable. Raises SaccadeError, with the scene, for one that cannot be
    worked on, and if a process has died.
    """
    if not work:
        return
    enforce_one_thread()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(work)), mp_context=context, initializer=_start_worker) as pool:
        waiting = {pool.submit(function, *arguments): scene for scene, arguments in work.items()}
        try:
            for future in as_completed(waiting):
                try:
                    result = future.result()
                except SaccadeError as error:
                    raise SaccadeError(f"scene {waiting[future]}: {error}") from error
                except BrokenProcessPool as error:
                    raise SaccadeError("one of the processes has died, perhaps for want of memory: give the same "
                                       "command again, with fewer --jobs") from error
                yield waiting[future], result
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle

    def watch() -> None:
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
