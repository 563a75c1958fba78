"""`python -m saccade.benchmarks.bag [out.json]` reads long ROS 2 bags, and measures speed and peak memory.

The bags hold images of 640x480 pixels at 10 Hz, raw or as JPEG, with their CameraInfo and tf at 50 Hz, in MCAP or
SQLite. They are written into a temporary folder and removed. The source of the camera service is compared with the
reader of `rosbags` alone, which decodes the same messages but no pixels, and with the same reader followed by Pillow.
They take turns, round after round, each in a process of its own, whose processor time counts: so other programs on the
machine do not disturb the ratios. The memory is that for two lengths.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from saccade.services.camera.ros.bag import open_bag_source
from saccade.shared.config import CameraConfig
from saccade.shared.files import replace_whole
from saccade.shared.log.provenance import commit
from saccade.shared.ros.types import CAMERA_INFO, COMPRESSED, IMAGE, IMAGES, NANOSECONDS, TF, make

ROUNDS = 3
SECONDS = (15, 60)  # of the two lengths
RATE_HZ, TRANSFORMS = 10, 5  # per image
SIZE_PX = (640, 480)
FIRST_NS = 1_700_000_000 * NANOSECONDS
BAGS = (("raw", "mcap"), ("jpeg", "mcap"), ("raw", "sqlite3"))
TOPICS = {IMAGE: "/camera/image_raw", COMPRESSED: "/camera/image_raw/compressed", CAMERA_INFO: "/camera/camera_info",
          TF: "/tf"}


def write(folder: Path, form: str, storage: str, seconds: int) -> None:
    """Writes a bag of that many seconds. Its images are smooth with some noise, so that their JPEG have a usual
    size."""
    types = get_typestore(Stores.ROS2_JAZZY)
    pictures = [_picture(k) for k in range(20)]
    with Writer(folder, version=9, storage_plugin=getattr(StoragePlugin, storage.upper())) as writer:
        connections: dict[str, Any] = {}
        for time_ns, kind, message in _messages(form, pictures, seconds):
            if kind not in connections:
                connections[kind] = writer.add_connection(TOPICS[kind], kind, typestore=types)
            writer.write(connections[kind], time_ns, types.serialize_cdr(message, kind))


def _messages(form: str, pictures: list[np.ndarray], seconds: int) -> Iterator[tuple[int, str, Any]]:
    jpegs = [_jpeg(picture) for picture in pictures]
    width, height = SIZE_PX
    for k in range(seconds * RATE_HZ):
        time_ns = FIRST_NS + k * NANOSECONDS // RATE_HZ
        for i in range(TRANSFORMS):
            yield time_ns, TF, _transform(time_ns + i * NANOSECONDS // (RATE_HZ * TRANSFORMS), k)
        yield time_ns, CAMERA_INFO, _camera_info(time_ns)
        which = k % len(pictures)
        if form == "jpeg":
            yield time_ns, COMPRESSED, make(COMPRESSED, {"header": _header(time_ns, "camera"), "format": "jpeg",
                                                         "data": jpegs[which]})
        else:
            yield time_ns, IMAGE, make(IMAGE, {
                "header": _header(time_ns, "camera"), "height": height, "width": width, "encoding": "bgr8",
                "is_bigendian": 0, "step": 3 * width, "data": pictures[which].reshape(-1)})


def _picture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 256, (24, 32, 3), np.uint8)).resize(SIZE_PX, Image.Resampling.BICUBIC)
    return np.clip(np.asarray(small) + rng.normal(0, 3, (*SIZE_PX[::-1], 3)), 0, 255).astype(np.uint8)


def _jpeg(picture: np.ndarray) -> np.ndarray:
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=90)
    return np.frombuffer(stream.getvalue(), np.uint8)


def _header(time_ns: int, frame: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", {"sec": time_ns // NANOSECONDS, "nanosec": time_ns % NANOSECONDS})
    return make("std_msgs/msg/Header", {"stamp": stamp, "frame_id": frame})


def _transform(time_ns: int, k: int) -> Any:
    move = make("geometry_msgs/msg/Transform", {
        "translation": make("geometry_msgs/msg/Vector3", {"x": 1e-3 * k, "y": 0.0, "z": 0.5}),
        "rotation": make("geometry_msgs/msg/Quaternion", {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0})})
    return make(TF, {"transforms": [make("geometry_msgs/msg/TransformStamped", {
        "header": _header(time_ns, "world"), "child_frame_id": "camera", "transform": move})]})


def _camera_info(time_ns: int) -> Any:
    width, height = SIZE_PX
    region = make("sensor_msgs/msg/RegionOfInterest", {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0,
                                                       "do_rectify": False})
    k = np.array([600, 0, width / 2, 0, 600, height / 2, 0, 0, 1], np.float64)
    return make(CAMERA_INFO, {
        "header": _header(time_ns, "camera"), "height": height, "width": width, "distortion_model": "plumb_bob",
        "d": np.zeros(5), "k": k, "r": np.eye(3).reshape(-1), "p": np.insert(k, (3, 6, 9), 0.0), "binning_x": 0,
        "binning_y": 0, "roi": region})


def read_by_rosbags(folder: Path, *, pixels: bool) -> int:
    """Counts the images of a bag, read and decoded from CDR by `rosbags`. With `pixels` they become RGB."""
    types, count = get_typestore(Stores.ROS2_JAZZY), 0
    with Reader(folder) as reader:
        wanted = [connection for connection in reader.connections if connection.msgtype in (*IMAGES, TF)]
        for connection, _, data in reader.messages(wanted):
            message: Any = types.deserialize_cdr(data, connection.msgtype)
            count += connection.msgtype in IMAGES
            if pixels and connection.msgtype == COMPRESSED:
                np.array(Image.open(io.BytesIO(bytes(message.data))))
            elif pixels and connection.msgtype == IMAGE:
                np.ascontiguousarray(message.data.reshape(message.height, message.width, 3)[..., ::-1])
    return count


def read_by_saccade(folder: Path) -> int:
    """Counts the images of a bag that come with their pose from the camera service's source."""
    source, *_ = open_bag_source(folder, CameraConfig())
    return sum(image.world_from_camera is not None for image in source)


def peak_mb() -> float:
    """Peak memory of this process. What getrusage tells begins with that of the process which started it."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


WAYS = {"reader alone": lambda folder: read_by_rosbags(folder, pixels=False),
        "reader and pixels": lambda folder: read_by_rosbags(folder, pixels=True), "saccade": read_by_saccade}


def measured(way: str, folder: Path) -> dict[str, float]:
    """Processor seconds, images and peak memory of a process that reads a bag in one of WAYS."""
    done = subprocess.run([sys.executable, "-m", "saccade.benchmarks.bag", "--read", way, folder], capture_output=True,
                          text=True, check=True)
    return json.loads(done.stdout)


def compare(form: str, storage: str, folder: Path) -> dict[str, Any]:
    """The rates of all ways on the longer bag, as medians over rounds, and the peak memory for both lengths."""
    paths = [folder / f"{form}_{storage}_{seconds}" for seconds in SECONDS]
    for path, seconds in zip(paths, SECONDS, strict=True):
        write(path, form, storage, seconds)
    rounds: list[dict[str, dict[str, float]]] = []
    for _ in range(ROUNDS):
        rounds.append({way: measured(way, paths[-1]) for way in WAYS})
    counts = {round_[way]["images"] for round_ in rounds for way in WAYS}
    if counts != {SECONDS[-1] * RATE_HZ}:
        raise SystemExit(f"saccade: {form} in {storage}: the ways read different numbers of images: {counts}")
    rates = {way: float(np.median([r[way]["images"] / r[way]["seconds"] for r in rounds])) for way in WAYS}
    ratios = {way: float(np.median([r[way]["seconds"] / r["saccade"]["seconds"] for r in rounds]))
              for way in WAYS if way != "saccade"}
    memory = {f"{seconds} s": measured("saccade", path)["peak_mb"]
              for path, seconds in zip(paths, SECONDS, strict=True)}
    return {"images": SECONDS[-1] * RATE_HZ, "megabytes": sum(f.stat().st_size for f in paths[-1].iterdir()) / 1e6,
            "images_per_s": rates, "rate_of": ratios, "peak_mb": memory, "rounds": rounds}


def main() -> None:
    """Prints a table. With a file's name it writes the numbers there."""
    if sys.argv[1:2] == ["--read"]:
        start_s = time.process_time()
        images = WAYS[sys.argv[2]](Path(sys.argv[3]))
        print(json.dumps({"seconds": time.process_time() - start_s, "images": images,
                          "peak_mb": peak_mb()}))
        return
    found = {}
    for form, storage in BAGS:
        with tempfile.TemporaryDirectory() as folder:
            found[f"{form} in {storage}"] = compare(form, storage, Path(folder))
        if len(sys.argv) > 1:  # what is measured is kept, because all takes long
            numbers = {"commit": commit(), "bags": found}
            replace_whole(Path(sys.argv[1]), (json.dumps(numbers, indent=1) + "\n").encode())
    table = Table("bag", "images per s", "of the reader alone", "of reader and pixels",
                  *(f"peak MB, {seconds} s" for seconds in SECONDS))
    for name, row in found.items():
        table.add_row(name, f"{row['images_per_s']['saccade']:.0f}", *(f"{x:.2f}" for x in row["rate_of"].values()),
                      *(f"{x:.0f}" for x in row["peak_mb"].values()))
    Console().print(table)


if __name__ == "__main__":
    main()
