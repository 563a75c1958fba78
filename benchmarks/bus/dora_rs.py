"""dora-rs: a dataflow of two Python nodes under `dora run`, which needs no other daemon."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from saccade.benchmarks.bus.measure import Plan, Receive, Send
from saccade.benchmarks.bus.peer import RECEIVER, ROLES, SENDER, command, run_all

OUTPUT = "frame"
QUEUE_SIZE = 1000  # with more messages dora would drop some
RUN_DORA = "import sys, dora_cli; sys.argv[0] = 'dora'; sys.exit(dora_cli.py_main())"


class DoraRs:
    """One node sends and one receives. They send in place (`send_output_raw`, with the fewest copies), or in the usual
    way (`send_output`)."""

    modules = ("dora", "dora_cli", "pyarrow")

    def __init__(self, name: str, in_place: bool) -> None:
        self.name = name
        self._in_place = in_place

    def run(self, plan: Plan, folder: Path) -> None:
        """Writes the dataflow; dora itself starts both ends."""
        python, *_ = command(self.name, SENDER, folder, "-")
        nodes: list[dict[str, object]] = [
            {"id": role, "path": python, "args": shlex.join(command(self.name, role, folder, "-")[1:])}
            for role in ROLES]
        nodes[ROLES.index(SENDER)]["outputs"] = [OUTPUT]
        nodes[ROLES.index(RECEIVER)]["inputs"] = {OUTPUT: {"source": f"{SENDER}/{OUTPUT}", "queue_size": QUEUE_SIZE}}
        dataflow = folder / "dataflow.yml"
        dataflow.write_text(json.dumps({"nodes": nodes}))  # JSON is YAML
        run_all([[sys.executable, "-c", RUN_DORA, "run", str(dataflow)]], plan, folder)

    @contextmanager
    def sender(self, address: str) -> Iterator[Send]:
        """Sends on the node's output."""
        from dora import Node

        node = Node()

        def send_in_place(payload: bytes) -> None:
            with node.send_output_raw(OUTPUT, len(payload)) as buffer, memoryview(buffer) as view:
                view[:] = payload

        yield send_in_place if self._in_place else lambda payload: node.send_output(OUTPUT, payload)

    @contextmanager
    def receiver(self, address: str) -> Iterator[Receive]:
        """Gives views of shared memory."""
        from dora import Node

        node = Node()

        def receive() -> memoryview:
            while (event := node.next()) is not None:
                if event["type"] == "INPUT":
                    return memoryview(event["value"].to_numpy())
            raise EOFError("the dataflow has ended")

        yield receive
