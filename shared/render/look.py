"""How a scene looks: its light, its table, its background, and the camera's exposure, colours, noise and blur.

A look is a TOML file, or the name of one that comes with Saccade (`shared/render/looks`). Paths in the file are
relative to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import ConfigDict, Field, FiniteFloat, ValidationInfo, field_validator

from saccade.shared.config import FLAT_LOOK, Section, checked
from saccade.shared.errors import SaccadeError, told
from saccade.shared.files import MIB, parse_toml, read_text
from saccade.shared.render.surfaces import SIDE_PX, SURFACES, surface
from saccade.shared.world.images import read_image

LOOKS = Path(__file__).parent / "looks"
RANDOM = "random"  # drawn anew for every scene
MOST_LIGHTS = 6
MAX_FILE_BYTES = 1 * MIB
_NEED = "give a look's TOML file, or the name of one that comes with Saccade"

Share = Annotated[FiniteFloat, Field(ge=0, le=4)]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Colour = tuple[Share, Share, Share]
RGB = NDArray[np.uint8]


class Light(Section):
    """A light from far away."""

    direction: Vector
    """The way the light travels, in the world's axes."""
    diffuse: Share = 0.6
    """Its strength on matt surfaces."""
    specular: Share = 0.1
    """Its strength in highlights."""
    shadow: bool = True
    """Whether it casts shadows."""

    @field_validator("direction")
    @classmethod
    def _points_somewhere(cls, value: Vector) -> Vector:
        if not any(value):
            raise ValueError("a direction must not be [0, 0, 0]")
        return value


class Look(Section):
    """A look. The default is flat: light from everywhere, no shadows, an ideal camera, as in the paper."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    exposure: Share = 1.0
    """Factor on the image."""
    white_balance: Colour = (1.0, 1.0, 1.0)
    """Factors on red, green and blue."""
    noise_sigma: float = Field(0.0, ge=0, le=255)
    """Standard deviation of the camera's noise, of 255."""
    blur_sigma_px: float = Field(0.0, ge=0, le=20)
    """Standard deviation of the camera's blur in pixels."""
    ambient: Share = 1.0
    """Light from everywhere."""
    headlight: Share = 0.0
    """Light from the camera."""
    lights: tuple[Light, ...] = Field((), max_length=MOST_LIGHTS)
    """Lights from far away."""
    object_specular: float = Field(0.0, ge=0, le=1)
    """How strongly objects reflect highlights."""
    table_texture: Any = None
    """Image of the table's surface: a file, or `wood`, `cloth`, `stone` or `tiles`. Without it the table has the
    scene's colour."""
    table_texture_m: float = Field(0.5, gt=0.001, le=100)
    """Side of that image on the table, in metres."""
    background: Any = None
    """What is behind the table: a colour [r, g, b] (0 to 255), an image file, or the name of a surface. Without it,
    black."""

    @field_validator("table_texture", "background")
    @classmethod
    def _loaded(cls, value: Any, info: ValidationInfo) -> RGB | None:
        if value is None or isinstance(value, np.ndarray):
            return value
        if isinstance(value, list | tuple) and info.field_name == "background":
            if len(value) != 3 or not all(isinstance(v, int | float) and 0 <= v <= 255 for v in value):
                raise ValueError("a colour is three numbers from 0 to 255")
            return np.full((1, 1, 3), np.array(value), dtype=np.uint8)
        if not isinstance(value, str) or not value:
            raise ValueError("give an image file" + (", or a colour" if info.field_name == "background" else ""))
        if value in SURFACES:
            return surface(value)
        folder = (info.context or {}).get("folder", Path())
        return _square(read_image(folder / value, what=info.field_name or "image"))

    @property
    def is_flat(self) -> bool:
        """Whether the scene is rendered without lights, textures and background."""
        return not (self.lights or self.headlight or self.table_texture is not None or self.background is not None
                    or self.ambient != 1.0)

    def seen(self, rgb: RGB, rng: np.random.Generator) -> RGB:
        """What the camera makes of a rendered image [H, W, 3]: exposure and white balance, then blur, then noise."""
        gain = self.exposure * np.array(self.white_balance)
        if np.all(gain == 1.0) and not self.noise_sigma and not self.blur_sigma_px:
            return rgb
        image = rgb.astype(np.float32) * gain.astype(np.float32)
        if self.blur_sigma_px:
            image = _blurred(image, self.blur_sigma_px)
        if self.noise_sigma:
            image += self.noise_sigma * rng.standard_normal(image.shape, dtype=np.float32)
        return image.round().clip(0, 255).astype(np.uint8)


FLAT = Look()


def load_look(name: str) -> Look:
    """Reads a look: the name of one that comes with Saccade, or a TOML file.

    Raises SaccadeError if it is missing, or if a key or a value in it is wrong.
    """
    if name == FLAT_LOOK:
        return FLAT
    path = LOOKS / f"{name}.toml"
    if not path.is_file():
        path = Path(name)
        if not path.is_file():
            known = ", ".join(sorted((FLAT_LOOK, RANDOM, *(each.stem for each in LOOKS.glob("*.toml")))))
            raise SaccadeError(f"look {told(name)} is unknown: choose from {known}, or give a TOML file")
    text = read_text(path, "look", _NEED, MAX_FILE_BYTES)
    try:
        tree = parse_toml(text)
    except ValueError as error:
        raise SaccadeError(f"look {path} is no TOML ({error}): {_NEED}") from error
    return checked(Look, tree, f"look {path}, key {{}}", {"folder": path.parent})


def random_look(rng: np.random.Generator) -> Look:
    """Draws a look: any light, any surface, any camera, as far as objects can still be seen."""
    def sometimes(share: float, value: Any, otherwise: Any) -> Any:
        return value if rng.random() < share else otherwise

    lights = []
    for _ in range(int(rng.integers(0, 4))):
        azimuth, down = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.4)
        direction = (np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down))
        lights.append(Light(direction=direction, diffuse=rng.uniform(0.2, 0.8), specular=rng.uniform(0, 0.4),
                            shadow=bool(rng.random() < 0.7)))
    strength = sum(light.diffuse for light in lights)
    surfaces = [*SURFACES.values()]

    def drawn() -> RGB:
        return surfaces[int(rng.integers(len(surfaces)))](rng)

    return Look(
        exposure=rng.uniform(0.6, 1.3), white_balance=tuple(rng.uniform(0.82, 1.18, 3)),
        noise_sigma=sometimes(0.5, rng.uniform(0, 8), 0.0), blur_sigma_px=sometimes(0.4, rng.uniform(0, 1.5), 0.0),
        ambient=max(0.25, rng.uniform(0.45, 1.0) - 0.4 * strength), headlight=sometimes(0.3, rng.uniform(0, 0.2), 0.0),
        lights=tuple(lights), object_specular=sometimes(0.5, rng.uniform(0, 0.5), 0.0),
        table_texture=sometimes(0.7, drawn(), None), table_texture_m=rng.uniform(0.2, 1.0),
        background=sometimes(0.6, drawn(), np.asarray(rng.integers(0, 256, (1, 1, 3)), dtype=np.uint8)))


def _square(rgb: RGB) -> RGB:
    """An image as a texture [512, 512, 3]."""
    return np.asarray(Image.fromarray(rgb).resize((SIDE_PX, SIDE_PX), Image.Resampling.BOX))


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """A Gaussian blur of an image [H, W, 3], with the border continued."""
    radius = max(1, int(np.ceil(3 * sigma_px)))
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_px) ** 2).astype(np.float32)
    weights /= weights.sum()
    for axis in (0, 1):
        padding = [(radius, radius) if n == axis else (0, 0) for n in range(3)]
        padded, length = np.pad(image, padding, mode="edge"), image.shape[axis]
        image = sum((w * np.take(padded, np.arange(k, k + length), axis=axis) for k, w in enumerate(weights)),
                    np.zeros_like(image))
    return image
