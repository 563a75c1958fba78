"""The table, the objects and the camera in MuJoCo, which renders images. No physics runs here: nothing moves by itself
(services/simulator/physics.py lets objects fall)."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from saccade.shared.errors import SaccadeError
from saccade.shared.render.look import FLAT, MOST_LIGHTS, Look
from saccade.shared.render.mesh import Mesh
from saccade.shared.render.opengl import HOW_TO_MEND, choose_backend
from saccade.shared.render.surfaces import SIDE_PX
from saccade.shared.world.geometry import IMAGE_SIZE_PX, INTRINSICS_PX, unit

choose_backend()
try:
    import mujoco
except (ImportError, AttributeError, OSError) as error:  # PyOpenGL raises AttributeError if the library is missing
    raise SaccadeError(f"{HOW_TO_MEND} ({error})") from error

TABLE_SIDE_M, TABLE_HALF_M = 1.0, 0.01  # side, and half the thickness
TABLE, PLAIN, SKY, OBSTACLE = "table", "plain", "sky", "obstacle"  # names in the model
SKY_PX = 256  # side of each of the background's six faces
LIGHT_M = 2.0  # how far from the centre of the table a light is put; it shines as from far away
NEAR_M, FAR_M = 0.05, 3.0
Furniture = tuple[ArrayLike, ArrayLike, float, ArrayLike]  # centre, size, yaw and colour of an obstacle
_OUT_OF_SIGHT = np.array([0.0, 0.0, -100.0])


def _build(meshes: tuple[Mesh, ...], further: Mapping[str, str], boxes: int) -> mujoco.MjModel:
    """Compiles the model. Every body is a mocap body, so that a new scene needs no compilation.

    `further` are more objects: their labels, and the names of their meshes. `boxes` is the number of obstacles.
    """
    spec = mujoco.MjSpec()
    spec.stat.extent, spec.stat.center = 1.0, [0, 0, 0]
    spec.visual.map.znear, spec.visual.map.zfar = NEAR_M, FAR_M
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [1, 1, 1], [0, 0, 0]
    spec.visual.headlight.specular = [0, 0, 0]
    spec.visual.global_.offwidth = spec.visual.global_.offheight = IMAGE_SIZE_PX
    half = TABLE_SIDE_M / 2
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[half, half, TABLE_HALF_M],
                            pos=[0, 0, -TABLE_HALF_M], contype=0, conaffinity=0)
    rig = spec.worldbody.add_body(name="camera", mocap=True)
    rig.add_camera(name="camera", resolution=[IMAGE_SIZE_PX] * 2, sensor_size=[1, 1], focal_pixel=[IMAGE_SIZE_PX] * 2)
    _add_surroundings(spec)
    for mesh in meshes:
        _add_object(spec, mesh)
    for label, name in further.items():
        _add_body(spec, label, name)
    for number in range(boxes):
        body = spec.worldbody.add_body(name=f"{OBSTACLE} {number}", mocap=True)
        body.add_geom(name=f"{OBSTACLE} {number}", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.01, 0.01],
                      contype=0, conaffinity=0)
    model = spec.compile()
    for mesh in meshes:  # faster than in the specification, which takes texels as single Python numbers
        start = model.tex_adr[model.tex(mesh.name).id]
        model.tex_data[start:start + mesh.texture.size] = np.flipud(mesh.texture).ravel()
    return model


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    """What looks need and the flat look does not show: lights, a texture for the table, and one for the background."""
    for number in range(MOST_LIGHTS):
        spec.worldbody.add_light(name=f"light {number}", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, active=False)
    for name, kind, height in ((TABLE, mujoco.mjtTexture.mjTEXTURE_2D, SIDE_PX),
                               (SKY, mujoco.mjtTexture.mjTEXTURE_SKYBOX, 6 * SKY_PX)):
        spec.add_texture(name=name, type=kind, width=height if name == TABLE else SKY_PX, height=height, nchannel=3,
                         builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT)
    spec.add_material(name=PLAIN, specular=0.0)
    textured = spec.add_material(name=TABLE, specular=0.0, texuniform=True)
    textured.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = TABLE


def _add_object(spec: mujoco.MjSpec, mesh: Mesh) -> None:
    height, width, _ = mesh.texture.shape
    spec.add_texture(name=mesh.name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3,
                     builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT)
    material = spec.add_material(name=mesh.name)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = mesh.name
    spec.add_mesh(name=mesh.name, uservert=mesh.vertices_m.ravel().tolist(), userface=mesh.faces.ravel().tolist(),
                  usertexcoord=mesh.texcoords.ravel().tolist(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    _add_body(spec, mesh.name, mesh.name)


def _add_body(spec: mujoco.MjSpec, label: str, name: str) -> None:
    body = spec.worldbody.add_body(name=label, mocap=True)
    body.add_geom(name=label, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0)


class World:
    """A scene that can be rendered.

    Each mesh is there once, under its name. `further` holds more objects, each with a label of its own and the name of
    its mesh. `boxes` says how many obstacles `furnish` can show.

    It must not be shared between threads, because the OpenGL context belongs to the thread that creates it. Raises
    SaccadeError if OpenGL does not work.
    """

    def __init__(self, meshes: tuple[Mesh, ...], *, size_px: int = IMAGE_SIZE_PX,
                 intrinsics_px: ArrayLike = INTRINSICS_PX, further: Mapping[str, str] | None = None, boxes: int = 0):
        self.meshes = {mesh.name: mesh for mesh in meshes}
        self.size_px, self.boxes = size_px, boxes
        self.model = _build(meshes, further or {}, boxes)
        self.model.vis.global_.offwidth = self.model.vis.global_.offheight = max(IMAGE_SIZE_PX, size_px)
        self.data = mujoco.MjData(self.model)
        self._rig = self.model.body("camera").mocapid[0]
        self._mocap = {label: self.model.body(label).mocapid[0] for label in (*self.meshes, *(further or {}))}
        try:
            self.renderer = mujoco.Renderer(self.model, height=size_px, width=size_px)
        except Exception as error:  # each OpenGL platform raises its own class
            raise SaccadeError(f"{HOW_TO_MEND} ({error})") from error
        weakref.finalize(self, self.renderer.close)  # closes it before the interpreter unloads OpenGL
        self.set_intrinsics(intrinsics_px)
        self.set_look(FLAT)
        self.place({})

    def set_intrinsics(self, intrinsics_px: ArrayLike) -> None:
        """Sets (fx, fy, cx, cy), in pixels of the rendered image. cx and cy are counted from its top left corner."""
        fx, fy, cx, cy = np.asarray(intrinsics_px, dtype=np.float64) / self.size_px
        # The sensor is 1 x 1 m, so metres on it are fractions of the image. MuJoCo shifts the sensor, not the image.
        self.model.cam_sensorsize[0] = (1.0, 1.0)
        self.model.cam_intrinsic[0] = (fx, fy, 0.5 - cx, 0.5 - cy)
        self.intrinsics_px = np.asarray(intrinsics_px, dtype=np.float64)

    def furnish(self, table_m: ArrayLike = (TABLE_SIDE_M, TABLE_SIDE_M, 0.0), obstacles: Sequence[Furniture] = ()
                ) -> None:
        """Gives the table other extents along x and y and another height of its top (`table_m` [3], metres), and puts
        obstacles around it: for each its centre [3], size [3], yaw (radians) and colour from 0 to 255."""
        x, y, top = np.asarray(table_m, dtype=np.float64)
        self.model.geom("table").size[:] = (x / 2, y / 2, TABLE_HALF_M)
        self.model.geom("table").pos[:] = (0.0, 0.0, top - TABLE_HALF_M)
        for number in range(self.boxes):
            geom, mocap = self.model.geom(f"{OBSTACLE} {number}"), self.model.body(f"{OBSTACLE} {number}").mocapid[0]
            geom.rgba[3] = float(number < len(obstacles))
            self.data.mocap_pos[mocap] = _OUT_OF_SIGHT
            if number < len(obstacles):
                center, size, yaw, rgb = obstacles[number]
                geom.size[:], geom.rgba[:3] = np.asarray(size) / 2, np.asarray(rgb) / 255.0
                self.data.mocap_pos[mocap] = center
                self.data.mocap_quat[mocap] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))

    def place(self, poses: Mapping[str, tuple[ArrayLike, float | NDArray[np.float64]]],
              table_rgb: ArrayLike = (128, 128, 128)) -> None:
        """Puts objects at (box centre [3] in metres, yaw in radians or rotation [3, 3]).

        Objects are named by their labels. Those that are not named are out of sight. `table_rgb` is from 0 to 255.
        """
        self.poses = dict(poses)
        textured = self.look.table_texture is not None
        self.model.geom("table").rgba[:3] = 1.0 if textured else np.asarray(table_rgb) / 255.0
        for name, mocap in self._mocap.items():
            self.model.geom(name).rgba[3] = float(name in poses)  # what is transparent is not drawn, which saves time
            center, turned = poses.get(name, (_OUT_OF_SIGHT, 0.0))
            self.data.mocap_pos[mocap] = center
            if isinstance(turned, np.ndarray):
                mujoco.mju_mat2Quat(self.data.mocap_quat[mocap], np.asarray(turned, dtype=np.float64).ravel())
            else:
                self.data.mocap_quat[mocap] = (np.cos(turned / 2), 0.0, 0.0, np.sin(turned / 2))

    def set_look(self, look: Look) -> None:
        """Sets lights, the table's surface and the background. It must be set before the objects are placed.

        What the camera does to the image (`Look.seen`) is not a part of the rendering.
        """
        self.look, model = look, self.model
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = look.ambient, look.headlight
        model.mat_specular[:] = look.object_specular
        for name in (PLAIN, TABLE):
            model.mat(name).specular[:] = 0.0
        for number in range(MOST_LIGHTS):
            light = model.light(f"light {number}")
            light.active[0] = number < len(look.lights)
            if number < len(look.lights):
                told = look.lights[number]
                towards = unit(told.direction)
                light.dir[:], light.pos[:] = towards, -LIGHT_M * towards
                light.diffuse[:], light.specular[:], light.castshadow[0] = told.diffuse, told.specular, told.shadow
        # Without a material the table is drawn as it always was.
        material = TABLE if look.table_texture is not None else PLAIN
        model.geom("table").matid[0] = -1 if look.is_flat else model.mat(material).id
        if look.table_texture is not None:
            model.mat(TABLE).texrepeat[:] = 1.0 / look.table_texture_m
            self._paint(TABLE, look.table_texture)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = look.background is not None
        if look.background is not None:
            face = Image.fromarray(look.background).resize((SKY_PX, SKY_PX), Image.Resampling.BOX)
            self._paint(SKY, np.concatenate([np.asarray(face)] * 6))

    def _paint(self, texture: str, rgb: NDArray[np.uint8]) -> None:
        """Gives a texture of the model another image [H, W, 3]."""
        number = self.model.tex(texture).id
        start = self.model.tex_adr[number]
        self.model.tex_data[start:start + rgb.size] = np.flipud(rgb).ravel()
        self.renderer._gl_context.make_current()  # MuJoCo has no other way to upload a texture
        mujoco.mjr_uploadTexture(self.model, self.renderer._mjr_context, number)

    def show_table(self, visible: bool) -> None:
        """Shows or hides the table. It is hidden in the views of the training set, which have a black background."""
        self.model.geom("table").rgba[3] = float(visible)

    def _prepare(self, world_from_camera: ArrayLike) -> None:
        camera = np.asarray(world_from_camera, dtype=np.float64)
        self.data.mocap_pos[self._rig] = camera[:3, 3]
        mujoco.mju_mat2Quat(self.data.mocap_quat[self._rig], camera[:3, :3].ravel())
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, camera="camera")

    def render(self, world_from_camera: ArrayLike) -> NDArray[np.uint8]:
        """Renders the RGB image [H, W, 3] from a camera pose world_from_camera [4, 4]."""
        self._prepare(world_from_camera)
        return self.renderer.render().copy()

    def render_depth(self, world_from_camera: ArrayLike) -> NDArray[np.float32]:
        """Renders the depth along the optical axis [H, W] in metres. Beyond the far plane it is FAR_M."""
        self.renderer.enable_depth_rendering()
        try:
            self._prepare(world_from_camera)
            return np.minimum(self.renderer.render(), FAR_M).astype(np.float32)
        finally:
            self.renderer.disable_depth_rendering()

    def render_masks(self, world_from_camera: ArrayLike) -> dict[str, NDArray[np.bool_]]:
        """Renders a mask [H, W] for every placed object: the pixels in which it is seen."""
        self.renderer.enable_segmentation_rendering()
        try:
            self._prepare(world_from_camera)
            ids = self.renderer.render()[..., 0].copy()
        finally:
            self.renderer.disable_segmentation_rendering()
        return {name: ids == self.model.geom(name).id for name in self.poses}

    def close(self) -> None:
        """Frees the OpenGL context."""
        self.renderer.close()
