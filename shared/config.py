"""The configuration: one typed object for a run, validated, and saved beside the log. An unknown key is an error.

The text under each key is its description in the guide's reference.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator

from saccade.shared.errors import SaccadeError, is_text, told
from saccade.shared.files import MIB, parse_json, parse_toml, read_text, replace_whole, size_of, writing
from saccade.shared.wording import MODULE, ROS_NAME, TOKEN, WORLD, plain_of

PACKAGE = Path(__file__).resolve().parent.parent  # the folder of `saccade`: in a checkout the repository
PRESETS, WEIGHTS = PACKAGE / "shared" / "presets", PACKAGE / "weights"

BUILT_IN_SETS = ("pantry", "ycb")
FLAT_LOOK = "flat"
MAX_FILE_BYTES = 1 * MIB
MAX_TEXT = 1024  # characters of a value; paths are the longest
MANY = 1_000_000  # limit for steps, scenes and the like; more would never end
_KEYS = "the guide's page 'Configuration' lists all keys"
_NEED = "give a file of TOML or JSON, or leave it out for the default"


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _can_be_told(cls, value: Any) -> Any:
        """Refuses texts that cannot go into messages, file names and onto a terminal."""
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str | Path) and not (len(str(text)) <= MAX_TEXT and is_text(str(text))):
                raise ValueError(f"a text must be Unicode, without control codes, of at most {MAX_TEXT} characters")
        return value


Checked = TypeVar("Checked", bound=Section)
ModuleName = Annotated[str, Field(pattern=MODULE)]
Focal = Annotated[FiniteFloat, Field(gt=0)]
PosesFormat = Literal["json-lines", "tum", "kitti", "euroc", "transforms", "colmap", "record3d", "stray"]


class BusConfig(Section):
    """Where the services of a run meet."""

    kind: Literal["zenoh", "local"] = "zenoh"
    """`zenoh`: each service is a process on a Zenoh bus. `local`: all services run within one process."""
    endpoint: str = "tcp/127.0.0.1:0"
    """Address of the router. With port 0, the launcher picks a free port."""
    listen: str | None = None
    """Address on which the router listens, if the other services know it by another one."""
    world: str = Field("table", pattern=WORLD)
    """Second part of every key. A world is one camera in one scene; several worlds can share a bus."""
    wait_for: tuple[str, ...] = ()
    """Services that must be ready before the source begins. The launcher fills this in."""
    live: bool = False
    """Nobody waits: each service takes the newest step and reports how many it skipped. Set for real cameras."""
    first_step: int = Field(0, ge=0, lt=2 ** 63)
    """First step of an episode. The replay of a log that was cut begins later than at 0."""


def sets_folder() -> Path:
    """Where the user's own object sets lie: SACCADE_OBJECTS if it is set, otherwise a folder of the user's data."""
    data = Path(os.environ.get("XDG_DATA_HOME", Path.home() / ".local" / "share"))
    return Path(os.environ.get("SACCADE_OBJECTS") or data / "saccade" / "objects")


def set_folder(objects: str) -> Path | None:
    """The folder of an object set of the user's. None if the set is built in."""
    if objects in BUILT_IN_SETS:
        return None
    return Path(objects).expanduser().resolve() if _is_path(objects) else sets_folder() / objects


def learned_folder(objects: str, architecture: str) -> Path:
    """Where the weights for an object set are kept."""
    suffix, folder = "" if architecture == "default" else f"-{architecture}", set_folder(objects)
    return WEIGHTS / f"{objects}{suffix}" if folder is None else folder / f"weights{suffix}"


def _is_path(objects: str) -> bool:
    return os.sep in objects or objects in (".", "..") or objects.startswith("~")


class SceneConfig(Section):
    """Which objects there are, and which episodes are run: those of a scenes file, or drawn from the seed."""

    objects: str = Field("pantry", min_length=1)
    """Object set: `pantry`, `ycb`, the name of one of your own, or the folder of one."""
    names: tuple[str, ...] | None = None
    """Only these objects of the set."""
    file: Path | None = None
    """Scenes file (JSON)."""
    scene: str | None = None
    """Id of one scene in the file. Without it, all scenes of the file are run."""
    count: int = Field(1, ge=1, le=MANY)
    """How many scenes are drawn."""
    n_objects: int | None = Field(None, ge=1, le=20)
    """How many objects stand on the table. Without it, the number is drawn."""
    yaw: Literal["random", "fixed"] = "random"
    """Whether drawn objects are turned about the vertical axis. In the paper they are not (`fixed`)."""
    goal_image: Path | None = None
    """Image of the view to find, instead of the scene's own goal: PNG or JPEG, of any size."""
    goal_intrinsics_px: tuple[Focal, Focal, FiniteFloat, FiniteFloat] | None = None
    """fx, fy, cx, cy of the goal image, in pixels. Without them, its EXIF data are asked."""
    explore: bool = False
    """No goal: the agent finds out what is on the table."""

    @field_validator("objects")
    @classmethod
    def _whole_path(cls, value: str) -> str:
        """A folder is held whole, because services and replays may run elsewhere."""
        return str(Path(value).expanduser().resolve()) if _is_path(value) else value

    @property
    def goal_view_is_known(self) -> bool:
        """Whether the truth's goal pose is that of the goal image, so that a distance to it tells."""
        return not self.explore and self.goal_image is None


class SimulatorConfig(Section):
    """The paper's environment (section 4.1)."""

    max_steps: int = Field(350, ge=1, le=MANY)
    """Steps after which an episode ends."""
    until: Literal["reached", "declared"] = "reached"
    """`reached`: an episode ends at the first step within the tolerance, as in the paper. `declared`: it ends when the
    agent says that it has arrived."""
    publish_depth: bool = False
    """Whether frames carry depth. PoseCNN uses it."""
    look: str = FLAT_LOOK
    """Light, surfaces and the camera's faults: the name of a look that comes with Saccade, or a TOML file."""
    goal_look: str | None = None
    """The look of the goal image, if it is another one."""


class CameraConfig(Section):
    """A real camera instead of the simulator. For what you leave out, Saccade assumes a value and says so."""

    source: str | None = None
    """A folder of images, a video file, a ROS 2 bag, a webcam (`webcam:0`), or a topic of ROS 2
    (`ros:/camera/image_raw`)."""
    poses: Path | None = None
    """File or folder with the camera's poses, in one of the formats of the guide's page about the camera."""
    pose_convention: Literal["opengl", "opencv"] | None = None
    """Camera axes of the poses. Without it, those of the format."""
    poses_format: PosesFormat | None = None
    """Format of the poses. Without it, it is told from the file."""
    poses_direction: Literal["world_from_camera", "camera_from_world"] | None = None
    """Whether a pose maps the camera to the world or the other way. Without it, as the format does."""
    poses_quaternion: Literal["xyzw", "wxyz"] | None = None
    """Order of a quaternion's numbers. Without it, that of the format or of its header."""
    poses_up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the file's world that points up. Without it, that of the format."""
    poses_scale: Focal = 1.0
    """Length in metres of the unit of the poses' positions."""
    poses_original: bool = False
    """Undo the `applied_transform` of a transforms.json."""
    intrinsics_px: tuple[Focal, Focal, FiniteFloat, FiniteFloat] | None = None
    """fx, fy, cx, cy of the source's images, in pixels."""
    board: Path | None = None
    """Description of a printed board on the table, which tells the camera's poses. `saccade board` writes it."""
    more_boards: tuple[Path, ...] = Field((), max_length=15)
    """Descriptions of further boards. Where they lie is learnt from images that show them together."""
    calibration: str | None = None
    """File that `saccade calibrate` wrote, or the name of a camera under which it is kept. It tells the intrinsics and
    the distortion of the lens, which is removed."""
    rate_hz: float = Field(10.0, gt=0, le=1000)
    """Images per second from a folder or a webcam. A video has its own rate."""
    loop: bool = False
    """Begin again with the first image after the last."""
    image_topic: str | None = None
    """Topic of the images in a ROS 2 bag. Without it, the only one, or the only one that has a CameraInfo."""
    pose_topic: str | None = None
    """Topic of poses (PoseStamped or Odometry) of ROS 2. Without it, one that is needed beside tf."""
    camera_frame: str | None = None
    """Frame of the camera in the tf of ROS 2: z points forward, y down. Without it, that of the images."""
    world_frame: str | None = None
    """Frame of tf that is the agent's world: z points up, the table's top is at z = 0. Without it, the root of tf."""


class RosConfig(Section):
    """ROS 2 nodes whose middleware is `rmw_zenoh`."""

    router: str = "tcp/127.0.0.1:7447"
    """Address of the Zenoh router of ROS 2."""
    domain: int = Field(0, ge=0, le=232)
    """Domain of ROS 2 (ROS_DOMAIN_ID)."""
    publish: bool = False
    """Publish the chosen viewpoint and the beliefs to ROS 2."""
    namespace: str = Field("/saccade", pattern=ROS_NAME)
    """Namespace of the topics that are published: `viewpoint` and `beliefs`."""


class PerceptionConfig(Section):
    """The networks that turn an image into percepts."""

    weights: Path | None = None
    """Folder with trained weights. Without it, those that come with the object set."""
    architecture: Literal["default", "paper", "posecnn", "lexa", "open"] = "default"
    """Which networks: Saccade's own, those of the paper's tables, PoseCNN, or the policy of LEXA."""
    passes: int = Field(2, ge=1, le=4)
    """How often each crop is corrected and cut again."""


class BeliefConfig(Section):
    """Particle filter of each object (paper, section 3.2) and the posterior over the goal's viewpoint."""

    particles: int = Field(10_000, ge=100, le=1_000_000)
    """Particles per object."""
    jitter_m: float = Field(0.002, gt=0, le=1)
    """Standard deviation of the noise that is added to resampled particles."""
    present_above: float = Field(0.6, ge=0, le=1)
    """An object counts as seen in an image if its presence is above this."""
    covariance: Literal["calibrated", "paper"] = "calibrated"
    """Uncertainty of a percept's position: as the network reports it, or fixed as in the paper."""
    hidden: Literal["outlines", "nearest"] = "outlines"
    """Where an object may be without being seen: behind the outline of a nearer object, or anywhere beyond the range of
    the nearest one (the paper's way)."""
    pose: Literal["fused", "last"] = "fused"
    """Views from which the goal's direction is inferred: all of them, or the last one (the paper's way)."""
    born: float = Field(0.02, ge=0, lt=1)
    """Prior probability that an object is where it is seen now and not where it was believed to be."""
    resample_below: float = Field(0.5, gt=0, le=1)
    """Particles are resampled when their effective share falls below this."""
    missed_weight: float = Field(0.3, gt=0, le=1)
    """Factor by which a particle loses weight when its object should have been seen and was not."""
    published_particles: int = Field(512, ge=16, le=8192)
    """How many particles a belief message carries."""
    keyframes: int = Field(24, ge=1, le=MANY)
    """How many views of an object are kept for its pose."""
    view_worth: float = Field(0.5, gt=0, le=1)
    """How much one view counts for the pose."""
    views_worth: float = Field(2.5, gt=0, le=MANY)
    """How much all views together count at most: they share the error of the goal's own percept."""


class PlannerConfig(Section):
    """Expected free energy over candidate viewpoints (paper, equation 5)."""

    candidates: int = Field(5_000, ge=10, le=1_000_000)
    """How many candidate viewpoints are drawn."""
    replan_every: int = Field(10, ge=1, le=MANY)
    """A new viewpoint is chosen after this many steps, or on arrival."""
    moved_by: Literal["agent", "hand", "recording"] | None = None
    """Who moves the camera. `agent`: it carries out every action. `hand`: a person, who needs many images to come to a
    viewpoint, so that the plan stays until it is reached or the hand goes elsewhere. `recording`: nobody. Without it,
    `hand` for a camera that runs now, `recording` for other images, and `agent` in the simulator."""
    step_m: float = Field(0.05, gt=0, le=0.5)
    """How far the camera moves in one step."""
    range_std_m: float = Field(0.025, gt=0, le=10)
    """Standard deviation of the preferred range around the goal's range."""
    goal_confidence: float = Field(0.7, ge=0, le=1)
    """If no object is recognised in the goal image with at least this probability, the agent explores."""
    goal_pixel: bool = True
    """Bring the target to the pixel where the goal image shows it, instead of to the centre."""
    retry: bool = True
    """When a viewpoint turns out not to show the goal's view, leave it for another one."""
    information_weight: float = Field(1.0, ge=0, le=MANY)
    """Weight of the expected information gain."""


class ServicesConfig(Section):
    """Modules of your own in the place of Saccade's services. Each declares a `SERVICE` and has `build(config)`."""

    source: ModuleName | None = None
    """In the place of the simulator, or of the camera with `--world camera`."""
    perception: ModuleName | None = None
    """In the place of perception."""
    belief: ModuleName | None = None
    """In the place of the belief."""
    planner: ModuleName | None = None
    """In the place of the planner."""


class ViewerConfig(Section):
    """The viewer in a browser."""

    address: str = "127.0.0.1"
    """Address on which the viewer listens. If other hosts can reach it, a browser needs the token."""
    published: str | None = None
    """Address on which a container's ports are published. With a loopback address a browser needs no token."""
    token: str | None = Field(None, pattern=TOKEN)
    """Token that a browser must give. The launcher draws a new one for every run and prints it in the address."""
    port: int = Field(9090, ge=1, le=65535)
    """Port of the page."""
    guide_port: int = Field(9092, ge=1, le=65535)
    """Port of the page that guides a hand that holds the camera. It listens on the viewer's address."""
    data_port: int = Field(0, ge=0, le=65535)
    """Port for Rerun viewers that are not a browser. With 0, a free port is picked."""
    memory_mb: int = Field(1024, ge=16, le=1_000_000)
    """Memory for the past of a run: a browser that comes late sees as much of it."""
    truth: bool = False
    """Also show what only the simulator knows: the goal's camera, and the objects as ghosts."""


class Config(Section):
    """A run."""

    run: str | None = Field(None, max_length=256)
    """Name of the run. Without it, the name of its folder."""
    seed: int = Field(0, ge=0, lt=2 ** 63)
    """Seed of everything random."""
    bus: BusConfig = BusConfig()
    scene: SceneConfig = SceneConfig()
    simulator: SimulatorConfig = SimulatorConfig()
    camera: CameraConfig = CameraConfig()
    perception: PerceptionConfig = PerceptionConfig()
    belief: BeliefConfig = BeliefConfig()
    planner: PlannerConfig = PlannerConfig()
    viewer: ViewerConfig = ViewerConfig()
    ros: RosConfig = RosConfig()
    services: ServicesConfig = ServicesConfig()

    @property
    def weights(self) -> Path:
        """The folder of the weights in use."""
        return self.perception.weights or learned_folder(self.scene.objects, self.perception.architecture)

    @property
    def names(self) -> tuple[str, ...]:
        """The objects of the run. Raises SaccadeError if they are not resolved yet."""
        if not self.scene.names:
            raise SaccadeError("configuration key 'scene.names' is empty: the objects of the run are not resolved")
        return self.scene.names

    def with_values(self, values: dict[str, Any]) -> Config:
        """Returns a copy with dotted keys replaced (`{"scene.yaw": "fixed"}`). Raises SaccadeError if a key is
        unknown."""
        tree = self.model_dump(mode="json")
        for dotted, value in values.items():
            node: Any = tree
            *parents, last = dotted.split(".")
            for parent in parents:
                node = node.get(parent) if isinstance(node, dict) else None
            if not isinstance(node, dict) or last not in node:
                raise SaccadeError(f"configuration key {told(dotted)} is unknown: {_KEYS}")
            node[last] = str(value) if isinstance(value, Path) else value
        return validate(tree, "the given values")

    def save(self, path: Path) -> None:
        """Writes the resolved configuration as JSON, whole or not at all. `load` reads it back. Raises SaccadeError if
        it cannot be written."""
        with writing(path, "configuration"):
            replace_whole(path, (self.model_dump_json(indent=2) + "\n").encode())


def validate(tree: dict[str, Any], where: str) -> Config:
    """Returns the configuration in a tree. Raises SaccadeError, which names the wrong key."""
    return checked(Config, tree, f"configuration key {{}} in {where}")


def checked(model: type[Checked], tree: dict[str, Any], what: str, context: dict[str, Any] | None = None) -> Checked:
    """Returns the section in a tree. Raises SaccadeError, which begins with `what`; the wrong key replaces its {}."""
    try:
        return model.model_validate(tree, context=context)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        keys = f"; {_KEYS}" if model is Config and first["type"] == "extra_forbidden" else ""
        where = what.replace("{}", told(key)) if key else re.sub(r",?(?: key)? \{\}", "", what)  # the whole has no key
        raise SaccadeError(f"{where}: {plain_of(first)}{keys}") from error


def recorded(text: str | None, where: str) -> Config:
    """Returns the configuration in a log, or the default if there is none. Raises SaccadeError if it is damaged."""
    if text is not None and len(text) > MAX_FILE_BYTES:
        raise SaccadeError(f"the configuration in {where} is larger than {size_of(MAX_FILE_BYTES)}: give another log")
    try:
        return validate(parse_json(text or "{}"), where)
    except ValueError as error:
        raise SaccadeError(f"the configuration in {where} is damaged ({error}): give another log, or look at this "
                           "one's messages with `saccade echo --log`") from error


def load(path: Path | None, preset: str | None = None) -> Config:
    """Reads TOML or JSON, or a preset by its name (`default`, `paper`). Returns the default if no path is given.

    With the name of a `preset`, what the file does not say is taken from that preset.
    """
    base = _tree(Path(preset)) if preset else {}
    if path is None or str(path) == "default":
        return validate(base, f"preset {preset}")
    return validate(merged(base, _tree(path)), str(path))


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Returns a tree that holds what `over` says, and for the rest what `base` says."""
    both = {key: merged(base[key], over[key]) for key in base.keys() & over.keys()
            if isinstance(base[key], dict) and isinstance(over[key], dict)}
    return base | over | both


def _tree(path: Path) -> dict[str, Any]:
    if os.path.isfile(PRESETS / f"{path}.toml"):
        path = PRESETS / f"{path}.toml"
    text = read_text(path, "configuration", _NEED, MAX_FILE_BYTES)
    try:
        tree = parse_json(text) if path.suffix == ".json" else parse_toml(text)
    except ValueError as error:
        raise SaccadeError(f"configuration {path} is neither TOML nor JSON ({error}): {_NEED}") from error
    if not isinstance(tree, dict):
        raise SaccadeError(f"configuration {path} is {type(tree).__name__}, not a table of keys: {_NEED}")
    return tree


def weights_folder(name: str | Path | None) -> Path | None:
    """Returns a folder of weights. A name stands for one that comes with Saccade, if no folder here has this name."""
    if not name:
        return None
    path = Path(name)
    return path if path.is_absolute() or os.path.isdir(path) else WEIGHTS / path
