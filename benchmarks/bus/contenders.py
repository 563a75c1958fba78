"""Who runs. Names are those of the results."""

from __future__ import annotations

from benchmarks.bus.dora_rs import DoraRs
from benchmarks.bus.ours import Ours
from benchmarks.bus.peer import Contender
from benchmarks.bus.pyzmq import PyZmq

OURS = "saccade"
CONTENDERS: dict[str, Contender] = {contender.name: contender for contender in (
    Ours(OURS, shared_memory=True),
    Ours("saccade, shm off", shared_memory=False),
    PyZmq("pyzmq, ipc", "ipc"),
    PyZmq("pyzmq, tcp", "tcp"),
    DoraRs("dora-rs", in_place=False),
    DoraRs("dora-rs, in place", in_place=True),
)}
