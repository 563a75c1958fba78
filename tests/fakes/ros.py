"""Messages of ROS 2 and bags of them, written by `rosbags`: for the tests of bags and of live topics."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_JAZZY)
STEP_NS = 100_000_000
FIRST_NS = 1_700_000_000_000_000_000
SIZE = (64, 48)
K = (61.0, 62.0, 31.5, 23.5)  # as ROS counts pixels
OPTICAL, WORLD = "camera_optical", "world"
IMAGE, INFO, TF, TF_STATIC = "/camera/image_raw", "/camera/camera_info", "/tf", "/tf_static"
TYPES = STORE.types


def made(name, **fields):
    package, _, short = name.rpartition("/")
    return TYPES[f"{package}/msg/{short}"](**fields)


def cdr(message):
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def header(time_ns, frame=OPTICAL):
    stamp = made("builtin_interfaces/Time", sec=time_ns // 10 ** 9, nanosec=time_ns % 10 ** 9)
    return made("std_msgs/Header", stamp=stamp, frame_id=frame)


def image(time_ns, rgb, encoding="rgb8", frame=OPTICAL, step=None):
    data = np.ascontiguousarray(rgb, dtype=np.uint8)
    height, width = data.shape[:2]
    return made("sensor_msgs/Image", header=header(time_ns, frame), height=height, width=width, encoding=encoding,
                is_bigendian=0, step=step or data[0].size, data=data.reshape(-1))


def compressed(time_ns, rgb, form="JPEG", frame=OPTICAL):
    stream = io.BytesIO()
    Image.fromarray(rgb).save(stream, form)
    return made("sensor_msgs/CompressedImage", header=header(time_ns, frame), format=form.lower(),
                data=np.frombuffer(stream.getvalue(), np.uint8))


def info(time_ns, size=SIZE, k=K, d=(), model="plumb_bob", p=None, roi=(0, 0, 0, 0)):
    fx, fy, cx, cy = k
    px, py, pcx, pcy = p or k
    region = made("sensor_msgs/RegionOfInterest", x_offset=roi[0], y_offset=roi[1], width=roi[2], height=roi[3],
                  do_rectify=False)
    return made("sensor_msgs/CameraInfo", header=header(time_ns), height=size[1], width=size[0],
                distortion_model=model, d=np.array(d, np.float64),
                k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64), r=np.eye(3).reshape(-1),
                p=np.array([px, 0, pcx, 0, 0, py, pcy, 0, 0, 0, 1, 0], np.float64), binning_x=0, binning_y=0,
                roi=region)


def pose(parent_from_child):
    x, y, z = map(float, parent_from_child[:3, 3])
    a, b, c, w = map(float, Rotation.from_matrix(parent_from_child[:3, :3]).as_quat())
    return made("geometry_msgs/Pose", position=made("geometry_msgs/Point", x=x, y=y, z=z),
                orientation=made("geometry_msgs/Quaternion", x=a, y=b, z=c, w=w))


def tf(time_ns, *links):
    """Of (parent, child, parent_from_child [4, 4])."""
    transforms = []
    for parent, child, matrix in links:
        at = pose(matrix)
        x, y, z = at.position.x, at.position.y, at.position.z
        move = made("geometry_msgs/Transform", translation=made("geometry_msgs/Vector3", x=x, y=y, z=z),
                    rotation=at.orientation)
        transforms.append(made("geometry_msgs/TransformStamped", header=header(time_ns, parent), child_frame_id=child,
                               transform=move))
    return made("tf2_msgs/TFMessage", transforms=transforms)


def pose_stamped(time_ns, matrix, frame=WORLD):
    return made("geometry_msgs/PoseStamped", header=header(time_ns, frame), pose=pose(matrix))


def odometry(time_ns, matrix, frame="odom", child="base"):
    zero = made("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
    twist = made("geometry_msgs/TwistWithCovariance", covariance=np.zeros(36),
                 twist=made("geometry_msgs/Twist", linear=zero, angular=zero))
    return made("nav_msgs/Odometry", header=header(time_ns, frame), child_frame_id=child, twist=twist,
                pose=made("geometry_msgs/PoseWithCovariance", pose=pose(matrix), covariance=np.zeros(36)))


def optical(world_from_camera):
    """The pose of the same camera as ROS tells it: z forward, y down."""
    return world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])


def bag(folder, messages, *, storage="mcap"):
    """Writes (topic, time of the recording, message or bytes of a kind) into a bag, and returns its folder."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP if storage == "mcap" else
                StoragePlugin.SQLITE3) as writer:
        write(writer, messages)
    return folder


def write(writer, messages):
    connections = {}
    for topic, time_ns, message in messages:
        kind, data = message if isinstance(message, tuple) else (message.__msgtype__, cdr(message))
        if (topic, kind) not in connections:
            connections[topic, kind] = writer.add_connection(topic, kind, typestore=STORE)
        writer.write(connections[topic, kind], time_ns, data)


def compressed_bag(folder, messages, mode):
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(getattr(CompressionMode, mode), CompressionFormat.ZSTD)
    with writer:
        write(writer, messages)
    return folder


def plain(count=5, world_from_camera=None, *, image_of=None, topic=IMAGE, step_ns=STEP_NS):
    """A camera whose images are their number, with its CameraInfo and tf: world -> base (moving) -> camera (fixed)."""
    base = np.eye(4)
    yield TF_STATIC, FIRST_NS, tf(FIRST_NS, ("base", OPTICAL, optical(world_from_camera)))
    for k in range(count):
        time_ns = FIRST_NS + k * step_ns
        yield TF, time_ns, tf(time_ns, (WORLD, "base", base))
        yield INFO, time_ns, info(time_ns)
        rgb = np.full((SIZE[1], SIZE[0], 3), k, np.uint8)
        yield topic, time_ns, (image_of or image)(time_ns, rgb)
