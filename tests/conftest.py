"""One thread per process, as the launcher gives its services: the same bytes everywhere, and no cores fought over.
Tests interrupt what they start, also where a shell has put them into the background and has SIGINT ignored."""

import functools
import signal

import pytest

from saccade.app.run.threads import enforce_one_thread, limit_torch

enforce_one_thread()
limit_torch()
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def small_banks():
    """Banks hold fewer views and landmarks: enough where it does not matter how well an object is seen."""
    from saccade.training.open import banks  # after the number of threads is set
    from saccade.training.open.landmarks import landmarks_from

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(banks, "landmarks_from", functools.partial(landmarks_from, count=10))
        patch.setattr(banks, "bank_from", functools.partial(banks.bank_from, count=120))
        yield
