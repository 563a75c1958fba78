"""One thread a process: sums of networks and matrices depend on their number, and services share the cores."""

from __future__ import annotations

import os

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def prefer_one_thread() -> None:
    """For this process and those that it starts, unless the user's environment says otherwise. Before NumPy loads."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


def enforce_one_thread() -> None:
    """For the processes that are started from here on, whatever the environment says."""
    os.environ.update(dict.fromkeys(VARIABLES, "1"))


def limit_torch() -> None:
    """What the environment says, one where it says nothing, also where torch was loaded before."""
    import torch

    torch.set_num_threads(int(os.environ.get(VARIABLES[0], "1")))
