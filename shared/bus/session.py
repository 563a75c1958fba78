"""Opens Zenoh sessions. Every endpoint is given by its address: Saccade never searches the network for others."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import socket

import zenoh

from saccade.shared.bus.topics import ROOT
from saccade.shared.bus.wire import MAX_BYTES
from saccade.shared.errors import SaccadeError

CONFIG_VARIABLE = "ZENOH_CONFIG"  # names a file of Zenoh's settings to begin with: certificates, passwords, access
# Publishers wait for slow readers, because in lockstep a lost message would stop the run. Onlookers are the exception.
# The router knows them by the id of their session, which is one of these ids. It gives an onlooker what fits into its
# queue and drops the rest, so nobody waits. Each onlooker draws its id at random. The router would refuse a second
# session with the same id, so there are many ids, and two onlookers hardly ever draw the same one.
ONLOOKERS = tuple(f"{0x5accade0000 + k:x}" for k in range(1 << 14))
QUEUE_BATCHES = 16  # batches of 64 KiB; a whole camera image fits into so many
DROP_FOR_ONLOOKERS = {"id": "onlookers", "zids": ONLOOKERS, "messages": ["put"], "key_exprs": [f"{ROOT}/**"],
                      "flows": ["egress"], "overwrite": {"congestion_control": "drop"}}


def open_session(endpoint: str, *, listen: bool, onlooker: bool, timeout_s: float) -> zenoh.Session:
    """Opens the router's session (`listen`), or the session of a client of the router at `endpoint`.

    Raises SaccadeError if the endpoint is in use (`listen`) or malformed, if the router does not answer within
    `timeout_s` seconds or refuses this client, or if the file of Zenoh's settings cannot be used.
    """
    file = os.environ.get(CONFIG_VARIABLE)
    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    except zenoh.ZError as error:
        raise SaccadeError(f"{CONFIG_VARIABLE}={file}: no configuration of Zenoh's: {str(error).split(' at /')[0]}"
                           ) from error
    settings: dict[str, object] = {
        "mode": "router" if listen else "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/link/rx/max_message_size": 2 * MAX_BYTES,
    }
    if listen:
        settings |= {"listen/endpoints": [endpoint], "qos/network": [DROP_FOR_ONLOOKERS],
                     "transport/link/tx/queue/size/data": QUEUE_BATCHES}
    else:
        settings |= {"connect/timeout_ms": int(timeout_s * 1000), "connect/exit_on_failure": True,
                     "connect/endpoints": [endpoint]}
    if onlooker:
        settings["id"] = random.choice(ONLOOKERS)
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SaccadeError(_explain(endpoint, listen, timeout_s, str(error))) from error


def _explain(endpoint: str, listen: bool, timeout_s: float, error: str) -> str:
    if "in use" in error:
        return f"bus at {endpoint}: the port is in use; choose another, or port 0 for a free one"
    if "Endpoints must be" in error or ("protocol" in error.lower() and "supported" in error):
        return f"bus endpoint {endpoint!r} is not an address such as tcp/127.0.0.1:7447"
    reason = error.split(" at /")[0]
    if listen:
        return f"bus at {endpoint}: cannot listen there: {reason}"
    if _is_open(endpoint):
        return (f"bus at {endpoint} is there, but does not let this one in: are the password, the certificates and the "
                f"protocol right ({CONFIG_VARIABLE}={os.environ.get(CONFIG_VARIABLE, 'not set')})?")
    return f"bus at {endpoint} does not answer within {timeout_s:g} s; is it running? ({reason})"


def _is_open(endpoint: str) -> bool:
    """Whether something listens at the endpoint."""
    match = re.fullmatch(r"\w+/(\[[0-9a-fA-F:]+\]|[^\[\]:]+):(\d+)", endpoint)
    if match is None:
        return False
    with contextlib.suppress(OSError, ValueError), socket.create_connection((match[1].strip("[]"), int(match[2])), 1.0):
        return True
    return False
