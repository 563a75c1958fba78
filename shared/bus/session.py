"""How a Zenoh session is opened. Every endpoint is named: nothing is scouted."""

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

CONFIG_VARIABLE = "ZENOH_CONFIG"  # a file of Zenoh's settings to begin with: certificates, passwords, access
# Publishers wait for whoever is slow: in lockstep a lost message would stop the world. Who only looks on is known to
# the router by its session's id, one of these, and gets what fits into its queue: the rest is dropped, nobody waits.
# They are drawn at random and so many that two hardly ever draw the same; the second would be refused.
ONLOOKERS = tuple(f"{0x5accade0000 + k:x}" for k in range(1 << 14))
QUEUE_BATCHES = 16  # of 64 KiB: a camera image fits in whole
DROP_FOR_ONLOOKERS = {"id": "onlookers", "zids": ONLOOKERS, "messages": ["put"], "key_exprs": [f"{ROOT}/**"],
                      "flows": ["egress"], "overwrite": {"congestion_control": "drop"}}


def open_session(endpoint: str, *, listen: bool, onlooker: bool, timeout_s: float) -> zenoh.Session:
    """The router's session (`listen`), or a client's of the router at the endpoint. Raises SaccadeError if the endpoint
    is in use (listen), malformed, or does not answer in time."""
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
    """Whether something listens there."""
    match = re.fullmatch(r"\w+/(\[[0-9a-fA-F:]+\]|[^\[\]:]+):(\d+)", endpoint)
    if match is None:
        return False
    with contextlib.suppress(OSError, ValueError), socket.create_connection((match[1].strip("[]"), int(match[2])), 1.0):
        return True
    return False
