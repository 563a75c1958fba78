"""One thread per process, as the launcher gives its services: the same bytes everywhere, and no cores fought over."""

from deploy.threads import enforce_one_thread, limit_torch

enforce_one_thread()
limit_torch()
