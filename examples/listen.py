"""Reads frames and beliefs off the bus of a run, without Saccade. Any language with Zenoh and MessagePack can do this.

    pip install eclipse-zenoh msgpack numpy
    python examples/listen.py tcp/127.0.0.1:PORT [COUNT]

The address is `bus.endpoint` in the run's config.json. docs/wire.md describes every key and field.
"""

import argparse
import json
import math
import queue

import msgpack
import numpy as np
import zenoh


def array(code: int, data: bytes) -> np.ndarray:
    """Extension type 1: MessagePack [dtype, shape], then the numbers, little-endian and row by row."""
    header = msgpack.Unpacker()
    header.feed(data[:128])
    dtype, shape = header.unpack()
    dtype = np.dtype("<" + dtype)
    return np.frombuffer(data, dtype, math.prod(shape), header.tell()).reshape(shape)


def main(endpoint: str, count: int) -> None:
    config = zenoh.Config()
    for key, value in {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}.items():
        config.insert_json5(key, json.dumps(value))
    arrived: queue.Queue[tuple[str, bytes]] = queue.Queue(maxsize=100)
    with zenoh.open(config) as session:
        for topic in ("frame", "belief/*"):
            session.declare_subscriber(f"saccade/*/{topic}", lambda s: arrived.put((str(s.key_expr), bytes(s.payload))))
        for _ in range(count):
            key, payload = arrived.get()
            message = msgpack.unpackb(payload, ext_hook=array)
            if message["type"] == "Frame":
                print(f"{key} step {message['step']}: image {message['rgb'].shape}, "
                      f"camera at {message['world_from_camera'][:3, 3].round(3).tolist()} m")
            else:
                print(f"{key} step {message['step']}: {message['object']} at {message['mean_m'].round(3).tolist()} m, "
                      f"there with probability {message['presence']:.2f}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Prints frames and beliefs from the bus of a run.")
    parser.add_argument("endpoint", help="address of the bus, such as tcp/127.0.0.1:41305: bus.endpoint in the run's "
                                         "config.json")
    parser.add_argument("count", nargs="?", type=int, default=100, help="end after so many messages (default: 100)")
    given = parser.parse_args()
    main(given.endpoint, given.count)
