"""Lamps, and the shader that computes the colour of every point of a surface from its finish.

The light is a formula of the direction (sky, ground, a lamp with a soft edge, a strip behind); dull surfaces scatter
it, and glossy ones mirror it. Clear bodies show the picture behind them, refracted by their normals and dimmed by their
thickness, by the law of Beer and Lambert, with Schlick's approximation of Fresnel reflection.
"""

import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files

import numpy as np

from mpmcli.render.render_scene import Appearance, RenderScene
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import View

CLEAR = ("water", "syrup", "translucent")  # finishes that show the background
# Names of the vertex attributes of the shader: lamp, sky, thickness; colour; roughness of the normal; normal.
LIGHT, TINT, ROUGH, OUTWARDS = "lightMC", "tintMC", "roughMC", "outwardsMC"
CARRIED = (LIGHT, TINT, ROUGH, OUTWARDS)
# Passed from vertices to fragments, sampled at the centroid of the covered part of the pixel.
VARYINGS = "centroid {0} vec4 carriedLight;\ncentroid {0} vec3 carriedTint, carriedRough, worldPoint, worldNormal;\n"
BEHIND = "behindTexture"  # name of the picture behind clear bodies, with its depth from 0, near, to 1, far, as alpha


def lights_of(scene: RenderScene, view: View, theme: Theme) -> dict[str, np.ndarray]:
    """Return directions (3,) to the lamps about a camera and colours (3,) in linear light, by their names in shaders.

    One lamp is over the left shoulder, one behind, one at the side.
    """
    right, up, back = (view.lamps or view).axes
    above = np.array(scene.up)
    dark = theme.name == "dark"
    return {
        "lampTo": _unit(-0.42 * right + 1.0 * above + 0.40 * back - 0.1 * up),
        "rimTo": _unit(0.55 * right + 0.55 * above - 0.75 * back),
        "fillTo": _unit(0.8 * right + 0.25 * above + 0.6 * back),
        "lampColor": np.array([1.50, 1.56, 1.66]) * 0.72 if dark else np.array([1.62, 1.55, 1.42]) * 0.66,
        "skyColor": np.array([0.30, 0.38, 0.52]) * (0.72 if dark else 1.25),
        "horizonColor": np.array([0.22, 0.26, 0.33]) if dark else np.array([0.86, 0.90, 0.95]),
        "groundColor": linear(theme.floor) * (1.0 if dark else 0.42) + (0.03 if dark else 0.0),
    }


def linear(color: str) -> np.ndarray:
    """Return "#rrggbb" in linear light, (3,): the inverse of a display's gamma of 2.2."""
    return np.array(rgb(color), np.float32) ** np.float32(2.2)


def vertex_code() -> tuple[str, str]:
    """Return the declarations and the code of the vertex shader that pass on the vertex attributes."""
    declared = f"in vec4 {LIGHT};\n" + "".join(f"in vec3 {name};\n" for name in CARRIED[1:])
    done = f"carriedLight = {LIGHT}; carriedTint = {TINT}; carriedRough = {ROUGH};\n"
    return declared + VARYINGS.format("out"), done + f"worldPoint = vertexMC.xyz; worldNormal = {OUTWARDS};"


def fragment_code(
    scene: RenderScene, view: View, theme: Theme, appearance: Appearance, finer: int, *, by_field: bool, walled: bool
) -> tuple[str, str]:
    """Return the declarations and the code of the fragment shader for one material.

    The window has `finer` pixels per pixel of the view, along each axis. Tints `by_field` represent values, so that
    light must not change them much. A `walled` body is flat where it touches the walls of the domain.
    """
    extent = np.subtract(scene.upper, scene.lower)
    right, up, back = view.axes
    constants = {
        **{"lowerWall": scene.lower, "upperWall": scene.upper, "upwards": scene.up},
        **lights_of(scene, view, theme),
        **{"cameraAt": view.position, "toCamera": back, "cameraRight": right, "cameraUp": up},
        **{"grainSize": [max(scene.distances)], "wallGap": [1e-5 * max(extent)]},
        "thickUnit": [0.3 * np.cbrt(np.prod(np.maximum(extent, 1e-12)))],
        "pictureSize": [finer * length for length in view.size],
        "pixelsToMetre": [finer * view.pixels_per_metre],
        "nearAndFar": [view.near, view.far],
    }
    parts = shader_parts()
    declared = VARYINGS.format("in") + "".join(map(_constant, constants, constants.values())) + parts["room"]
    kind: str = "field" if by_field else appearance.finish
    if appearance.name.startswith("lava") and kind == "syrup":
        kind = "lava"
    towards = "toCamera" if view.parallel else "normalize(cameraAt - worldPoint)"
    common = parts["common"].replace("TOWARDS", towards).replace("WALLED", str(walled).lower())
    behind = parts["behind"] if kind in CLEAR else ""
    return declared, common + behind + parts.get(kind, parts["matte"]) + parts["tone"]


@cache
def shader_parts() -> dict[str, str]:
    """Return the parts of `lighting.glsl` by name."""
    text = files("mpmcli.render").joinpath("lighting.glsl").read_text(encoding="utf-8")
    return dict(re.findall(r"^//// (\w+)(\n.*?)(?=^////|\Z)", text, re.MULTILINE | re.DOTALL))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _constant(name: str, values: Sequence[float]) -> str:
    """Return the declaration of a number or of a vector."""
    kind = "float" if len(values) == 1 else f"vec{len(values)}"
    return f"const {kind} {name} = {kind}({', '.join(f'{value:#.9g}' for value in values)});\n"
