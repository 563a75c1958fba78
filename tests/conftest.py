"""One thread per process, as the launcher gives its services: the same bytes everywhere, and no cores fought over.
Tests interrupt what they start, also where a shell has put them into the background and has SIGINT ignored."""

import signal

from saccade.app.run.threads import enforce_one_thread, limit_torch

enforce_one_thread()
limit_torch()
signal.signal(signal.SIGINT, signal.default_int_handler)
