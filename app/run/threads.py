"""One thread for each process. The sums in networks and matrices depend on the number of threads, and the services
share the cores."""

from __future__ import annotations

import os

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def prefer_one_thread() -> None:
    """Sets one thread for this process and those that it starts, unless the user's environment sets another number. It
    must be called before NumPy is loaded."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


def enforce_one_thread() -> None:
    """Sets one thread for all processes that are started from now on, whatever the environment says."""
    os.environ.update(dict.fromkeys(VARIABLES, "1"))


def limit_torch() -> None:
    """Gives PyTorch the number of threads in the environment, by default one. It also works after PyTorch was
    loaded."""
    import torch

    torch.set_num_threads(int(os.environ.get(VARIABLES[0], "1")))
