"""Files of poses in every format, written from known poses by the formats' own rules, without the code that reads."""

from __future__ import annotations

import json
import struct
import zipfile

import numpy as np
from scipy.spatial.transform import Rotation

from saccade.shared.world.geometry import look_at
from saccade.tests.fakes.camera import line, written

COUNT = 6
LENS = (610.0, 620.0, 325.0, 238.0)  # fx, fy, cx, cy of images of SIZE
SIZE = (640, 480)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
NAMES = [f"view_{k}.png" for k in range(COUNT)]
# World axes in which ARKit writes (y up: its x is ours, its y our z, its z our -y), and KITTI (y down).
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def path_of(count=COUNT):
    """A camera's way [N, 4, 4] in Saccade's axes that no mirror, turn or inverse leaves as it is: it rises, comes
    nearer and rolls."""
    poses = []
    for k in range(count):
        pose = look_at([0.5 - 0.03 * k, 0.1 + 0.11 * k, 0.25 + 0.05 * k ** 1.5], [0.04 * k, 0.02, 0.05])
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", 0.1 + 0.07 * k).as_matrix()
        poses.append(pose)
    return np.array(poses)


TRUE = path_of()
TIMES_S = 0.25 * np.arange(COUNT) + 3.0


def quaternions(poses, order="xyzw"):
    found = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return found if order == "xyzw" else found[:, [3, 0, 1, 2]]


def rows(poses, order="xyzw"):
    """Position and quaternion [N, 7]."""
    return np.hstack([poses[:, :3, 3], quaternions(poses, order)])


def words(numbers, between=" "):
    return between.join(f"{x:.12f}" for x in numbers)


def tum(path, between=" ", times=TIMES_S, head="# timestamp tx ty tz qx qy qz qw\n", end="\n"):
    lines = [words([t, *row], between) for t, row in zip(times, rows(TRUE @ FLIP), strict=True)]
    path.write_bytes((head + end.join(lines) + end).encode())
    return path


def kitti(path):
    """Rows of a 3x4 matrix; the world's y axis points down."""
    path.write_text("".join(words(pose[:3].ravel()) + "\n" for pose in Y_DOWN @ TRUE @ FLIP))
    return path


def euroc(path, start_ns=1_403_636_579_763_555_584):
    head = ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
            "v_RS_R_x [m s^-1]\n")
    lines = [f"{start_ns + int(k * 250_000_000)},{words([*row, 0.1], ',')}"
             for k, row in enumerate(rows(TRUE @ FLIP, "wxyz"))]
    path.write_text(head + "\n".join(lines) + "\n")
    return path


def transforms(path, poses=TRUE, **more):
    frames = [{"file_path": f"./images/{name}", "transform_matrix": pose.tolist()}
              for name, pose in zip(NAMES, poses, strict=True)]
    tree = {"camera_model": "OPENCV", "fl_x": LENS[0], "fl_y": LENS[1], "cx": LENS[2], "cy": LENS[3], "w": SIZE[0],
            "h": SIZE[1], "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames}
    path.write_text(json.dumps({**tree, **more}, indent=1))
    return path


def colmap_text(folder, camera="1 OPENCV 640 480 610 620 325 238 0.1 0 0 0"):
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    inverses = np.linalg.inv(TRUE @ FLIP)
    for k, (q, pose) in enumerate(zip(quaternions(inverses, "wxyz"), inverses, strict=True)):
        lines += [f"{k + 1} {words([*q, *pose[:3, 3]])} 1 {NAMES[k]}", "1.5 2.5 -1 3.5 4.5 7" if k % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def colmap_binary(folder, model=1, parameters=LENS):
    folder.mkdir(exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ", 1, 1, model, *SIZE)
                                         + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", COUNT)
    inverses = np.linalg.inv(TRUE @ FLIP)
    for k, (q, pose) in enumerate(zip(quaternions(inverses, "wxyz"), inverses, strict=True)):
        data += struct.pack("<I7dI", k + 1, *q, *pose[:3, 3], 1) + NAMES[k].encode() + b"\0" + struct.pack("<Q", k)
        data += struct.pack("<ddq", 1.0, 2.0, -1) * k
    (folder / "images.bin").write_bytes(data)
    return folder


def record3d(path, **more):
    """K column by column; quaternion x y z w before the position; ARKit's axes: y up, OpenGL cameras."""
    there = Y_UP @ TRUE
    tree = {"w": SIZE[0], "h": SIZE[1], "fps": 4, "K": [LENS[0], 0, 0, 0, LENS[1], 0, LENS[2], LENS[3], 1],
            "poses": np.hstack([quaternions(there), there[:, :3, 3]]).tolist()}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps({**tree, **more}), zipfile.ZIP_DEFLATED)
        archive.writestr("rgbd/0.jpg", b"not read")
    return path


def stray(folder):
    folder.mkdir(exist_ok=True)
    (folder / "camera_matrix.csv").write_text(f"{LENS[0]}, 0.0, {LENS[2]}\n0.0, {LENS[1]}, {LENS[3]}\n0.0, 0.0, 1.0\n")
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    lines += [f"{TIMES_S[k]:.6f}, {2 * k:06d}, {words(row, ', ')}" for k, row in enumerate(rows(Y_UP @ TRUE @ FLIP))]
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    return folder


GOOD = {
    "tum": lambda folder: tum(folder / "a.txt"),
    "kitti": lambda folder: kitti(folder / "00.txt"),
    "euroc": lambda folder: euroc(folder / "data.csv"),
    "transforms": lambda folder: transforms(folder / "transforms.json"),
    "colmap": lambda folder: colmap_text(folder / "model"),
    "colmap binary": lambda folder: colmap_binary(folder / "model"),
    "record3d": lambda folder: record3d(folder / "a.r3d"),
    "stray": lambda folder: stray(folder / "scan"),
    "json-lines": lambda folder: written(folder / "a.jsonl", *(line(pose, index=k) for k, pose in enumerate(TRUE))),
}
