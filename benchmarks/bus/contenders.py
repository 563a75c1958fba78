"""The contenders, under the names that they have in the results. This command runs one end of a contender:

    python -m saccade.benchmarks.bus.contenders CONTENDER ROLE FOLDER ADDRESS
"""

from __future__ import annotations

import sys
from pathlib import Path

from saccade.benchmarks.bus.dora_rs import DoraRs
from saccade.benchmarks.bus.ours import Ours
from saccade.benchmarks.bus.peer import Contender, serve
from saccade.benchmarks.bus.pyzmq import PyZmq

OURS = "saccade"
CONTENDERS: dict[str, Contender] = {contender.name: contender for contender in (
    Ours(OURS, shared_memory=True),
    Ours("saccade, shm off", shared_memory=False),
    PyZmq("pyzmq, ipc", "ipc"),
    PyZmq("pyzmq, tcp", "tcp"),
    DoraRs("dora-rs", in_place=False),
    DoraRs("dora-rs, in place", in_place=True),
)}

if __name__ == "__main__":
    serve(CONTENDERS[sys.argv[1]], sys.argv[2], Path(sys.argv[3]), sys.argv[4])
