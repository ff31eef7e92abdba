"""What a geom's surface looks like: its picture, where each corner lies on it, and its gloss."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.view.wrap import around_places, flat_places

_GREY = np.array([0.5, 0.5, 0.5, 1.0])

_EXPONENT = 128.0
"""Of MuJoCo's highlights, at shininess 1."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Skin:
    """The surface of a geom.

    Attributes:
        image: Red, green, blue and opacity, shape (h, w, 4), top row first.
        places: Where each corner of each triangle lies on it, (m, 3, 2): u to the right and v down,
            1 for the whole picture, which repeats beyond.
        roughness: Of the surface, 0 (mirror) to 1 (chalk).
        metallic: 0 to 1.
    """

    image: NDArray[np.uint8]
    places: Array
    roughness: float
    metallic: float

    @property
    def opacity(self) -> float:
        """The largest opacity of the picture, 0 to 1."""
        return float(self.image[..., 3].max()) / 255.0


def skin_of(model: mujoco.MjModel, geom: int, triangles: Array) -> Skin:
    """Returns how a geom looks.

    Args:
        model: The scene.
        geom: Its index.
        triangles: In its frame, (m, 3, 3) in m.
    """
    material = int(model.geom_matid[geom])
    colour = _colour(model, geom)
    places = np.zeros((len(triangles), 3, 2))
    texture = -1 if material < 0 else _texture(model, material)
    image = np.ones((1, 1, 4))
    if texture >= 0:
        image = _image(model, texture)
        places_of = around_places if is_around(model, geom) else flat_places
        places = places_of(model, geom, triangles)
    roughness, metallic = _gloss(model, material)
    shown = np.round(255.0 * image * colour).astype(np.uint8)
    return Skin(image=shown, places=places, roughness=roughness, metallic=metallic)


def is_around(model: mujoco.MjModel, geom: int) -> bool:
    """Returns whether a geom has a cube texture."""
    material = int(model.geom_matid[geom])
    texture = -1 if material < 0 else _texture(model, material)
    return texture >= 0 and model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D


def _colour(model: mujoco.MjModel, geom: int) -> Array:
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    is_own = material < 0 or not np.allclose(own, _GREY)
    return np.asarray(own if is_own else model.mat_rgba[material], dtype=np.float64)


def _gloss(model: mujoco.MjModel, material: int) -> tuple[float, float]:
    """Returns roughness and metallic; MuJoCo's highlights have another law.

    A highlight with exponent n is about as wide as one of roughness (2/(n + 2))^¼; a weak one is
    drawn as a rougher surface.

    References:
        Walter et al., "Microfacet models for refraction", 2007 (α = √(2/(n + 2)), roughness √α).
    """
    if material < 0:
        return 0.7, 0.0
    metallic = float(model.mat_metallic[material])
    roughness = float(model.mat_roughness[material])
    if roughness < 0.0:  # not given
        exponent = _EXPONENT * float(model.mat_shininess[material])
        glossy = (2.0 / (exponent + 2.0)) ** 0.25
        roughness = 1.0 - float(model.mat_specular[material]) * (1.0 - glossy)
    return min(roughness, 1.0), min(max(metallic, 0.0), 1.0)


def _texture(model: mujoco.MjModel, material: int) -> int:
    roles = (mujoco.mjtTextureRole.mjTEXROLE_RGB, mujoco.mjtTextureRole.mjTEXROLE_RGBA)
    found = [int(model.mat_texid[material, role]) for role in roles]
    return max(found)


def _image(model: mujoco.MjModel, texture: int) -> Array:
    """Returns a texture's picture, 0 to 1, (h, w, 4); a cube's sides one below the other."""
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[first : first + height * width * channels]
    image = np.ones((height, width, 4))
    image[..., :channels] = data.reshape(height, width, channels) / 255.0
    if channels == 1:
        image[..., 1:3] = image[..., :1]
    return image
