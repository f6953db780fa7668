"""Lamps, and how each finish meets their light: the shader that colours every point of a surface.

The light is a formula of the direction (sky, ground, a lamp with a soft edge, a strip behind): it lights
what is dull and is mirrored in what is glossy. What is clear shows the picture behind it, bent by its normals and
dimmed by its thickness, after the law of Beer and Lambert, with Schlick's approximation of Fresnel's mirror.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.render.appearance import Appearance, Finish
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.shading.material_groups import Group
from mpmcli.render.shading.occlusion import Occlusion, occlusion_of
from mpmcli.render.theme import Theme, rgb
from mpmcli.render.view import View

# Finishes that show what is behind them.
CLEAR = ("water", "syrup", "translucent")
# How much of the light that falls on it a finish holds back from what is below: 1 is a full shadow.
OPACITY: dict[Finish, float] = {"water": 0.22, "syrup": 0.55, "translucent": 0.6}
# Names of what each vertex carries to the shader: lamp, sky, thickness; colour; roughness of the normal; normal.
LIGHT, TINT, ROUGH, OUTWARDS = "lightMC", "tintMC", "roughMC", "outwardsMC"
CARRIED = (LIGHT, TINT, ROUGH, OUTWARDS)
# Name of the picture behind clear things.
BEHIND = "behindTexture"


@dataclass(frozen=True)
class Lights:
    """Directions (3,) towards the lights, in the scene, and their colours (3,), linear.

    Attributes:
        lamp, rim, fill: directions.
        lamp_color, sky, horizon, ground: colours, in linear light.
    """

    lamp: np.ndarray
    rim: np.ndarray
    fill: np.ndarray
    lamp_color: np.ndarray
    sky: np.ndarray
    horizon: np.ndarray
    ground: np.ndarray


def occlusion_by(
    scene: RenderScene,
    groups: Sequence[Group],
    lamp: np.ndarray,
    shades: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> Occlusion | None:
    """Return what the particles of some groups take of the light of a lamp in direction (3,), None without any.

    Args:
        shades: places (n, 3) and volumes (n,) of what is opaque besides.
    """
    if not groups and not shades:
        return None
    counts = [len(group.position) for group in groups] + [len(places) for places, _ in shades]
    opacities = [OPACITY.get(group.appearance.finish, 1.0) for group in groups] + [1.0] * len(shades)
    cells = [np.full(len(group.position), group.distance**3) for group in groups]
    volumes = np.concatenate([*cells, *(volumes for _, volumes in shades)])
    places = np.concatenate([*(group.position for group in groups), *(places for places, _ in shades)])
    return occlusion_of(scene, places, volumes, np.repeat(opacities, counts), lamp)


def lights_of(scene: RenderScene, view: View, theme: Theme) -> Lights:
    """Set up the lamps about a camera: one over the left shoulder, one behind, one from the side."""
    right, up, back = view.axes
    above = np.array(scene.up)
    dark = theme.name == "dark"
    return Lights(
        lamp=_unit(-0.42 * right + 1.0 * above + 0.40 * back - 0.1 * up),
        rim=_unit(0.55 * right + 0.55 * above - 0.75 * back),
        fill=_unit(0.8 * right + 0.25 * above + 0.6 * back),
        lamp_color=np.array([1.50, 1.56, 1.66]) * 0.72 if dark else np.array([1.62, 1.55, 1.42]) * 0.66,
        sky=np.array([0.30, 0.38, 0.52]) * (0.72 if dark else 1.25),
        horizon=np.array([0.22, 0.26, 0.33]) if dark else np.array([0.86, 0.90, 0.95]),
        ground=linear(theme.floor) * (1.0 if dark else 0.42) + (0.03 if dark else 0.0),
    )


def linear(color: str) -> np.ndarray:
    """Return "#rrggbb" in linear light, (3,): the inverse of a display's gamma of 2.2."""
    return np.array(rgb(color)) ** 2.2


def vertex_code() -> tuple[str, str]:
    """Return what the vertex shader declares and does to hand over what the vertices carry."""
    declared = f"in vec4 {LIGHT};\n" + "".join(f"in vec3 {name};\n" for name in CARRIED[1:])
    done = f"carriedLight = {LIGHT}; carriedTint = {TINT}; carriedRough = {ROUGH};\n"
    return declared + _carried("out"), done + f"worldPoint = vertexMC.xyz; worldNormal = {OUTWARDS};"


def fragment_code(
    scene: RenderScene,
    view: View,
    lights: Lights,
    appearance: Appearance,
    finer: int,
    *,
    by_field: bool,
    walled: bool = True,
) -> tuple[str, str]:
    """Return what the fragment shader declares and does for one material.

    Args:
        finer: pixels of the window to one of the view, along each axis.
        by_field: the tints mean something, so that light must not change them much.
        walled: what lies at the walls of the domain leans on them, and is flat there.
    """
    side = max(np.subtract(scene.upper, scene.lower))
    volume_length = float(np.prod(np.maximum(np.subtract(scene.upper, scene.lower), 1e-12))) ** (1 / 3)
    constants = {
        "lowerWall": _vec(scene.lower),
        "upperWall": _vec(scene.upper),
        "upwards": _vec(scene.up),
        "lampTo": _vec(lights.lamp),
        "rimTo": _vec(lights.rim),
        "fillTo": _vec(lights.fill),
        "lampColor": _vec(lights.lamp_color),
        "skyColor": _vec(lights.sky),
        "horizonColor": _vec(lights.horizon),
        "groundColor": _vec(lights.ground),
        "cameraAt": _vec(view.position),
        "toCamera": _vec(view.axes[2]),
        "cameraRight": _vec(view.axes[0]),
        "cameraUp": _vec(view.axes[1]),
    }
    declared = _carried("in")
    declared += "".join(f"const vec3 {name} = {value};\n" for name, value in constants.items())
    declared += f"const float grainSize = {max(scene.distances):.9g};\n"
    declared += f"const float wallGap = {1e-5 * side:.9g};\n"
    declared += f"const float thickUnit = {0.3 * volume_length:.9g};\n"
    declared += f"const vec2 pictureSize = vec2({finer * view.size[0]}.0, {finer * view.size[1]}.0);\n"
    declared += f"const float pixelsToMetre = {finer * view.pixels_per_metre:.9g};\n"
    declared += _ROOM
    kind: str = "field" if by_field else appearance.finish
    if appearance.name.startswith("lava") and kind == "syrup":
        kind = "lava"
    towards = "toCamera" if view.parallel else "normalize(cameraAt - worldPoint)"
    common = _COMMON.replace("TOWARDS", towards).replace("WALLED", "true" if walled else "false")
    return declared, common + _FINISHES.get(kind, _FINISHES["matte"]) + _TONE


def _carried(direction: str) -> str:
    """Return the declarations of the varyings, sampled at the centroid of the covered part of the pixel."""
    names = ("carriedTint", "carriedRough", "worldPoint", "worldNormal")
    return f"centroid {direction} vec4 carriedLight;\n" + "".join(f"centroid {direction} vec3 {n};\n" for n in names)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _vec(values: tuple[float, ...] | np.ndarray) -> str:
    return "vec3(" + ", ".join(f"{float(value):.9g}" if value % 1 else f"{float(value):.1f}" for value in values) + ")"


_ROOM = """
vec3 roomLight(vec3 d, float blur) {
    float rise = dot(d, upwards);
    vec3 c = mix(horizonColor, skyColor, smoothstep(-0.05 - 0.3 * blur, 0.75, rise));
    c = mix(groundColor, c, smoothstep(-0.12 - 0.5 * blur, 0.06 + 0.5 * blur, rise));
    float edge = 0.03 + 0.5 * blur;
    c += lampColor * 2.2 * (1.0 - 0.75 * blur) * smoothstep(0.90 - edge, 0.90 + edge, dot(d, lampTo));
    c += lampColor * 0.8 * (1.0 - 0.75 * blur) * smoothstep(0.86 - edge, 0.86 + edge, dot(d, rimTo));
    return c;
}
vec3 softLight(vec3 n) {
    float rise = 0.5 + 0.5 * dot(n, upwards);
    return mix(0.55 * groundColor, 0.55 * skyColor + 0.35 * horizonColor, rise);
}
float wrapped(float c, float w) { return max((c + w) / (1.0 + w), 0.0); }
float mirror(float c, float f) { return f + (1.0 - f) * pow(1.0 - clamp(c, 0.0, 1.0), 5.0); }
"""

# n, v: normal and direction of the viewer; lamp, sky: shares of light; thick: of what is clear, in units.
_COMMON = """
vec3 n = normalize(worldNormal);
vec3 v = TOWARDS;
vec3 flat_ = step(upperWall - wallGap, worldPoint) - step(worldPoint, lowerWall + wallGap);
bool atWall = WALLED && dot(flat_, flat_) > 0.5;
if (atWall) { n = normalize(flat_); }
float facing = dot(n, v);
if (facing < 0.02) { n = normalize(n + (0.02 - facing) * v); facing = dot(n, v); }
float lamp = carriedLight.x;
float sky = carriedLight.y;
float thick = carriedLight.z / thickUnit;
vec3 base = carriedTint;
vec3 gaps = min(worldPoint - lowerWall, upperWall - worldPoint);
// Where the surface bends into a wall its normals are between the two, and would glint.
float free_ = smoothstep(0.1, 1.5, min(gaps.x, min(gaps.y, gaps.z)) / grainSize);
vec3 color = base;
vec2 here = gl_FragCoord.xy / pictureSize;
"""

_TONE = """
color = min(color, vec3(8.0));
vec3 over = max(color - 0.7, vec3(0.0));
color = min(color, vec3(0.7)) + 0.3 * over / (over + 0.3);
fragOutput0 = vec4(pow(max(color, vec3(0.0)), vec3(1.0 / 2.2)), 1.0);
"""

_BEHIND = """
vec2 bend = -vec2(dot(n, cameraRight), dot(n, cameraUp)) * min(carriedLight.z, thickUnit) * BENT * pixelsToMetre;
if (atWall) { bend = vec2(0.0); }
vec2 place = clamp(here + bend / pictureSize, vec2(0.002), vec2(0.998));
vec3 behind = pow(texture(behindTexture, place).rgb, vec3(2.2));
"""

_FINISHES = {
    "matte": """
color = base * (lampColor * lamp * wrapped(dot(n, lampTo), 0.12) + sky * softLight(n)
        + 0.12 * max(dot(n, fillTo), 0.0) * sky);
color += mirror(facing, 0.04) * 0.35 * sky * roomLight(reflect(-v, n), 0.55);
""",
    "field": """
color = base * (0.50 + 0.34 * lamp * wrapped(dot(n, lampTo), 0.35) + 0.26 * sky * (0.6 + 0.4 * dot(n, upwards)));
color += 0.06 * mirror(facing, 0.04) * sky;
""",
    "metal": """
vec3 tinted = base + (1.0 - base) * pow(1.0 - facing, 5.0);
color = tinted * roomLight(reflect(-v, n), 0.22) * mix(0.35, 1.0, sky) * 0.9;
color += base * 0.35 * (lampColor * lamp * max(dot(n, lampTo), 0.0) + sky * softLight(n));
""",
    "crumbly": """
n = normalize(n + 0.5 * carriedRough);
float grit = 0.95 + 0.10 * carriedRough.x;
vec3 shade = mix(vec3(0.66, 0.78, 1.0), vec3(1.0), clamp(lamp, 0.0, 1.0));
color = base * grit * (0.60 * lampColor * lamp * wrapped(dot(n, lampTo), 0.45)
        + 1.05 * shade * (0.35 + 0.65 * sky) * (0.4 * softLight(n) + 0.6 * softLight(upwards)) + 0.10);
""",
    "translucent": _BEHIND.replace("BENT", "0.16")
    + """
float through = exp(-2.0 * thick);
vec3 pure = base / max(max(base.r, base.g), max(base.b, 1e-3));
vec3 pale = mix(base, pow(base, vec3(0.55)), 0.55);
float round_ = wrapped(dot(n, lampTo), 0.6);
vec3 body = mix(base, pale, 0.25 * round_ + 0.5 * through)
        * (lampColor * (0.35 + 0.65 * lamp) * round_ * 0.62 + (0.35 + 0.65 * sky) * softLight(n) * 0.75);
body += pale * 0.30 * pow(wrapped(dot(n, rimTo), 0.4), 2.0) * lampColor * (1.0 - 0.6 * facing);
body += pale * 0.20 * pow(1.0 - facing, 2.0) * sky;
vec3 seen = behind * pow(pure, vec3(0.55 + 0.5 * thick));
color = mix(body, seen, 0.10 + 0.60 * through);
color += mirror(facing, 0.045) * mix(0.35, 1.0, sky) * roomLight(reflect(-v, n), 0.05) * 0.8;
color += free_ * lamp * lampColor * 0.5 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 90.0);
""",
    "water": _BEHIND.replace("BENT", "0.22")
    + """
vec3 clear = pow(base / max(max(base.r, base.g), max(base.b, 1e-3)), vec3(0.7));
float depth = 0.20 + thick;
vec3 dimmed = pow(clear, vec3(1.3 * (1.0 - exp(-1.1 * depth)))) * exp(-0.55 * depth);
vec3 glow = base * (0.60 * softLight(vec3(upwards)) * (0.3 + 0.7 * sky) + 0.28 * lampColor * lamp);
vec3 inside = behind * dimmed + glow * (1.0 - exp(-1.3 * depth));
float shine = mirror(facing, 0.05);
vec3 mirrored = mix(0.45, 1.0, sky) * roomLight(reflect(-v, n), 0.06) * 1.15;
if (atWall) { shine *= 0.45; }
color = mix(inside, mirrored, shine);
// The film that the eye sees where the surface bends into the glass.
float bent_ = atWall ? smoothstep(0.05, 0.6, 1.0 - dot(normalize(worldNormal), n)) : 0.0;
color += bent_ * 0.35 * softLight(vec3(upwards));
color += free_ * lamp * lampColor * 1.2 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 200.0);
color += free_ * 0.10 * sky * softLight(n) * pow(1.0 - facing, 2.0);
""",
    "syrup": _BEHIND.replace("BENT", "0.2")
    + """
vec3 clear = base / max(max(base.r, base.g), max(base.b, 1e-3));
vec3 dimmed = pow(clear, vec3(0.6 + 5.0 * thick)) * exp(-2.0 * thick);
vec3 rich = pow(base, vec3(mix(0.9, 1.7, 1.0 - exp(-1.5 * thick))));
vec3 body = rich * (lampColor * (0.3 + 0.7 * lamp) * wrapped(dot(n, lampTo), 0.5) + sky * softLight(n));
color = behind * dimmed + body * (1.0 - exp(-5.0 * thick));
color = mix(color, mix(0.4, 1.0, sky) * roomLight(reflect(-v, n), 0.02), mirror(facing, 0.04));
color += lamp * lampColor * 1.6 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 160.0);
""",
    "lava": """
float heat = clamp(0.45 + 0.55 * facing + 0.25 * carriedRough.x, 0.0, 1.2);
color = base * (0.5 * lampColor * lamp * wrapped(dot(n, lampTo), 0.2) + 0.5 * sky * softLight(n));
color += mix(vec3(0.5, 0.02, 0.0), vec3(1.5, 0.36, 0.03), heat * heat) * heat;
color += mirror(facing, 0.04) * 0.4 * sky * roomLight(reflect(-v, n), 0.3);
""",
}
