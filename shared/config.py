"""Typed configuration: one object for a run, validated, saved beside its log. An unknown key is an error."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from saccade.shared.errors import SaccadeError

PACKAGE = Path(__file__).resolve().parent.parent  # the folder of `saccade`: in a checkout the repository
PRESETS, WEIGHTS = PACKAGE / "shared" / "presets", PACKAGE / "weights"


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Checked = TypeVar("Checked", bound=Section)
ModuleName = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*$")]
Focal = Annotated[FiniteFloat, Field(gt=0)]


class BusConfig(Section):
    """Where services meet. Loopback unless told otherwise; no multicast."""

    kind: Literal["zenoh", "local"] = "zenoh"
    endpoint: str = "tcp/127.0.0.1:0"  # port 0: the launcher picks a free one
    listen: str | None = None  # where the router listens, if others know it by another address
    world: str = Field("table", pattern=r"^[A-Za-z0-9_-]{1,64}$")
    wait_for: tuple[str, ...] = ()  # services that must be ready before the source begins; the launcher fills it in
    live: bool = False  # nobody waits: each service takes the newest step and says what it skipped
    first_step: int = Field(0, ge=0)  # of an episode in lockstep: a log that was cut begins later


class SceneConfig(Section):
    """Which episodes: those of a scenes file, or drawn from a seed."""

    objects: Literal["pantry", "ycb"] = "pantry"
    names: tuple[str, ...] | None = None  # a subset of the set
    file: Path | None = None
    scene: str | None = None  # an id in the file; all of them where absent
    count: int = Field(1, ge=1)
    n_objects: int | None = Field(None, ge=1, le=20)
    yaw: Literal["random", "fixed"] = "random"
    goal_image: Path | None = None
    explore: bool = False

    @property
    def goal_view_is_known(self) -> bool:
        """Whether the truth's goal pose is that of the goal image, so that a distance to it tells."""
        return not self.explore and self.goal_image is None


class SimulatorConfig(Section):
    """The paper's environment (section 4.1)."""

    max_steps: int = Field(350, ge=1)
    until: Literal["reached", "declared"] = "reached"  # the paper's any-time success, or the agent's own word
    publish_depth: bool = False  # no agent of ours needs it


class CameraConfig(Section):
    """Real images in the simulator's place; what is absent is assumed, and the camera says so."""

    source: str | None = None  # a folder of images, a video file, or a webcam: webcam:0
    poses: Path | None = None  # JSON lines or TUM
    pose_convention: Literal["opengl", "opencv"] | None = None  # JSON lines are OpenGL, TUM is OpenCV where absent
    intrinsics_px: tuple[Focal, Focal, FiniteFloat, FiniteFloat] | None = None  # fx, fy, cx, cy of the source's images
    rate_hz: float = Field(10.0, gt=0, le=1000)  # of a folder and of a webcam; a video has its own
    loop: bool = False


class PerceptionConfig(Section):
    """`weights`: a folder with a manifest; the object set's own, of that architecture, where absent."""

    weights: Path | None = None
    architecture: Literal["default", "paper"] = "default"
    passes: int = Field(2, ge=1, le=4)  # crops are corrected and cut again


class BeliefConfig(Section):
    """Particle filter per object (section 3.2) and the posterior over goal views."""

    particles: int = Field(10_000, ge=100, le=1_000_000)
    jitter_m: float = Field(0.002, gt=0)
    present_above: float = Field(0.6, ge=0, le=1)
    covariance: Literal["calibrated", "paper"] = "calibrated"  # of a percept: as the network is sure, or fixed
    hidden: Literal["outlines", "nearest"] = "outlines"  # not looked for: behind an object's outline, or its range
    pose: Literal["fused", "last"] = "fused"  # views that the goal's direction is inferred from
    born: float = Field(0.02, ge=0, lt=1)  # prior that an object is where it is seen and not where it was believed
    resample_below: float = Field(0.5, gt=0, le=1)  # effective share of particles
    missed_weight: float = Field(0.3, gt=0, le=1)
    published_particles: int = Field(512, ge=16)
    keyframes: int = Field(24, ge=1)
    view_worth: float = Field(0.5, gt=0, le=1)  # how much a view counts for the pose,
    views_worth: float = Field(2.5, gt=0)  # and all views together


class PlannerConfig(Section):
    """Expected free energy over candidate viewpoints (equation 5)."""

    candidates: int = Field(5_000, ge=10, le=1_000_000)
    replan_every: int = Field(10, ge=1)
    step_m: float = Field(0.05, gt=0, le=0.5)
    range_std_m: float = Field(0.025, gt=0)
    goal_confidence: float = Field(0.7, ge=0, le=1)  # below it the goal image says nothing
    goal_pixel: bool = True  # the target is brought to where the goal image shows it, not to the centre
    retry: bool = True  # a view that was not the goal's is left for another
    information_weight: float = Field(1.0, ge=0)


class ServicesConfig(Section):
    """Modules from outside that stand in the place of our services: each declares a SERVICE and builds a core."""

    source: ModuleName | None = None  # of the simulator, or of the camera where that is the world
    perception: ModuleName | None = None
    belief: ModuleName | None = None
    planner: ModuleName | None = None


class ViewerConfig(Section):
    """Where browsers find the viewer, and what it may keep. The page is on `port`, its data on `data_port` (0: a free
    one); `truth`: also what the simulator alone knows."""

    address: str = "127.0.0.1"
    port: int = Field(9090, ge=1, le=65535)
    data_port: int = Field(0, ge=0, le=65535)
    memory_mb: int = Field(1024, ge=16, le=1_000_000)
    truth: bool = False


class Config(Section):
    """A run. `run` is its name; where absent, that of its folder."""

    run: str | None = None
    seed: int = Field(0, ge=0)
    bus: BusConfig = BusConfig()
    scene: SceneConfig = SceneConfig()
    simulator: SimulatorConfig = SimulatorConfig()
    camera: CameraConfig = CameraConfig()
    perception: PerceptionConfig = PerceptionConfig()
    belief: BeliefConfig = BeliefConfig()
    planner: PlannerConfig = PlannerConfig()
    viewer: ViewerConfig = ViewerConfig()
    services: ServicesConfig = ServicesConfig()

    @property
    def weights(self) -> Path:
        """The folder of the weights in use."""
        suffix = "" if self.perception.architecture == "default" else f"-{self.perception.architecture}"
        return self.perception.weights or WEIGHTS / f"{self.scene.objects}{suffix}"

    @property
    def names(self) -> tuple[str, ...]:
        """The objects of the run. Raises SaccadeError where they are not resolved."""
        if not self.scene.names:
            raise SaccadeError("configuration key 'scene.names' is empty: the objects of the run are not resolved")
        return self.scene.names

    def with_values(self, values: dict[str, Any]) -> Config:
        """A copy with dotted keys replaced (`{"scene.yaw": "fixed"}`). Raises SaccadeError for an unknown key."""
        tree = self.model_dump(mode="json")
        for dotted, value in values.items():
            node = tree
            *parents, last = dotted.split(".")
            for parent in parents:
                node = node.get(parent) if isinstance(node, dict) else None
            if not isinstance(node, dict) or last not in node:
                raise SaccadeError(f"configuration key {dotted!r} is unknown: see shared/config.py")
            node[last] = str(value) if isinstance(value, Path) else value
        return validate(tree, "command line")

    def save(self, path: Path) -> None:
        """Writes the resolved configuration as JSON; `load` reads it back."""
        path.write_text(self.model_dump_json(indent=2) + "\n")


def validate(tree: dict[str, Any], where: str) -> Config:
    """The configuration in a tree. Raises SaccadeError that names the key."""
    return checked(Config, tree, f"configuration key {{}} in {where}")


def checked(model: type[Checked], tree: dict[str, Any], what: str) -> Checked:
    """The section in a tree. Raises SaccadeError; in `what` the key stands for {}."""
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise SaccadeError(f"{what.replace('{}', repr(key))}: {first['msg']}") from error


def load(path: Path | None) -> Config:
    """Reads TOML or JSON, or a preset by its name (`default`, `paper`); the default where no path is given."""
    if path is None or str(path) == "default":
        return Config()
    if (PRESETS / f"{path}.toml").is_file():
        path = PRESETS / f"{path}.toml"
    try:
        text = path.read_text()
        tree = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise SaccadeError(f"configuration {path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SaccadeError(f"configuration {path} is neither TOML nor JSON: {error}") from error
    return validate(tree, str(path))


def weights_folder(name: str | Path | None) -> Path | None:
    """A folder of weights, or the one of that name among those that come with Saccade."""
    if not name:
        return None
    path = Path(name)
    return path if path.is_absolute() or path.is_dir() else WEIGHTS / path
