"""Bad scenes, each with its sentence: file, line, key path, what is wrong, what would be right."""

import tomllib
from collections.abc import Iterator
from typing import Any, get_args

import pytest
from good_scene import GOOD, refusal

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene
from mpmcli.scene.examples import examples
from mpmcli.scene.problem import listed, quoted
from mpmcli.scene.schema import ParticleField

LAW_NAMES = quoted(sorted(str(model.model_fields["law"].default) for model in parameter_models()))
FIELD_NAMES = quoted(
    list(dict.fromkeys([*get_args(ParticleField), *(v.name for model in parameter_models() for v in model.internal)]))
)

# What is replaced in GOOD, by what, and the one line that answers.
REPLACED = [
    ("density = 1000.0", "densty = 1000.0", '11: bodies[0].material.densty: unknown key; did you mean "density"?'),
    ("end = 1.5", "end = 1.5\nduration = 3",
     "8: time.duration: unknown key; the keys here are end, frames, safety and step"),
    ("end = 1.5", "end = 1.5\nspacing = 3", "8: time.spacing: unknown key here; it belongs to [domain]"),
    ("ball = {", "sphere = {", '15: bodies[1].shape.sphere: unknown key; did you mean "ball"?'),
    # Nothing is said about the value of a key that was only guessed.
    ('name = "drop"', 'name = "drop"\ndamping = 0.1', '15: bodies[1].damping: unknown key; did you mean "sampling"?'),
    ("[time]", "[tme]", '6: tme: unknown key; did you mean "time"?'),
    ("end = 1.5\n", "", "6: time.end: missing key: simulated time, s; the scene starts at 0"),
    ("end = 1.5", 'end = "1.5"', '7: time.end: must be a number; found "1.5"'),
    ("end = 1.5", "end = true", "7: time.end: must be a number; found true"),
    ("end = 1.5", "end = inf", "7: time.end: must be a finite number; found inf"),
    ("end = 1.5", "end = 1979-05-27", "7: time.end: must be a number; found 1979-05-27"),
    ("end = 1.5", "end = 0", "7: time.end: must be greater than 0; found 0"),
    ("end = 1.5", "end = 1\nsafety = 1.5", "8: time.safety: must be at most 1; found 1.5"),
    ("end = 1.5", "end = 1\nstep = 0", '8: time.step: must be greater than 0 or "auto"; found 0'),
    ("end = 1.5", 'end = 1\nstep = "atuo"',
     '8: time.step: must be a number or "auto"; found "atuo"; did you mean "auto"?'),
    ("end = 1.5", "end = 1\nsafety = 0", "8: time.safety: must be greater than 0; found 0"),
    ("end = 1.5", "end = 1e16", "7: time.end: is beyond what can be computed with, 1e+15 at most; found 1e+16"),
    ("end = 1.5", "end = 1e-16", "7: time.end: is below what can be computed with, 1e-15 at least; found 1e-16"),
    ("frames = 150", "frames = 0", "8: time.frames: must be at least 1; found 0"),
    ("frames = 150", "frames = 1.5", "8: time.frames: must be a whole number; found 1.5"),
    ("density = 1000.0", "density = -1000.0", "11: bodies[0].material.density: must be greater than 0; found -1000.0"),
    ("density = 1000.0", 'density = "1000"', '11: bodies[0].material.density: must be a number; found "1000"'),
    ("youngs_modulus = 1e5\n", "",
     "16: bodies[1].material.youngs_modulus: missing key: Young's modulus E, Pa; or its knob springiness, 0 to 1"),
    ('bulk_modulus = "auto"', "bulk_modulus = -1",
     '11: bodies[0].material.bulk_modulus: must be greater than 0 or "auto"; found -1'),
    ('"neo_hookean"', '"neo_hokean"',
     '17: bodies[1].material.law: unknown law "neo_hokean"; did you mean "neo_hookean"? '
     f"The laws are {listed(LAW_NAMES, 'and')}"),
    ('law = "neo_hookean"\n', "",
     f"16: bodies[1].material.law: missing key: the constitutive law, {listed(LAW_NAMES)}; or a preset, "
     '"water", "honey", "lava", "mud", "jelly", "rubber", "snow", "sand", "clay" or "metal"'),
    ("size = [4.0, 2.0]", "size = [4.0]", "3: domain.size: needs two numbers (2D) or three (3D); found 1"),
    ("size = [4.0, 2.0]", "size = 4.0", "3: domain.size: must be a list in brackets; found 4.0"),
    ("size = [4.0, 2.0]", 'size = [4.0, "2"]', '3: domain.size[1]: must be a number; found "2"'),
    ("gravity = [0.0, -9.81]", "gravity = [0.0, 0.0, -9.81]",
     "5: domain.gravity: needs two numbers in this 2D scene (as many as domain.size); found 3"),
    ("center = [3.0, 1.0]", "center = [3.0, 1.0, 0.0]",
     "15: bodies[1].shape.ball.center: needs two numbers in this 2D scene (as many as domain.size); found 3"),
    ("spacing = 0.02", "spacing = 0.03",
     "3: domain.size: must be a whole number of cells of spacing 0.03 m: 4 m is 133.333 cells along x, "
     "3.99 or 4.02 m would fit; 2 m is 66.6667 cells along y, 1.98 or 2.01 m would fit"),
    ("spacing = 0.02\n", "", '2: domain: missing key "spacing" (m), or "cells" (a number per axis) in its place'),
    ("spacing = 0.02", "spacing = 0.02\ncells = [200, 100]",
     '5: domain.cells: "spacing" is given as well; leave one of them out'),
    ("spacing = 0.02", "cells = [200, 90]",
     "4: domain.cells: must make square cells; found 0.02 m along x, 0.0222222 m along y; "
     "nearest to the size is [200, 100]"),
    ("spacing = 0.02", "cells = [200]", "4: domain.cells: needs two numbers, as domain.size has; found 1"),
    ("spacing = 0.02", "spacing = 1e-12",
     "4: domain.spacing: makes more than 2147483647 cells along an axis; make it coarser"),
    ("[time]", 'walls = "slippery"\n[time]',
     '6: domain.walls: must be "slip", "stick", "separate", "periodic" or "open", or a table with one of them per '
     'face; found "slippery"'),
    ("[time]", '[domain.walls]\nx_min = "stik"\n[time]',
     '7: domain.walls.x_min: must be "slip", "stick", "separate", "periodic" or "open"; found "stik"; '
     'did you mean "stick"?'),
    ("[time]", '[domain.walls]\nz_min = "stick"\n[time]',
     "7: domain.walls.z_min: is a face of a 3D scene and this one is 2D; leave it out"),
    ('name = "drop"', 'name = "drop"\ncolliders = []',
     "15: bodies[1].colliders: unknown key here; it belongs at the top"),
    ("radius = 0.5 }", "radius = 0.5 }\nshape.add = { ball = { center = [3.0, 1.0], radius = 0.6 } }",
     "16: bodies[1].shape.add: must be a list of tables: write add = [{ ... }]; found a table with ball"),
    ("ball = {", "bal = {", '15: bodies[1].shape.bal: unknown key; did you mean "ball"?'),
    ("[bodies.material]", "shape.box = { min = [3, 1], max = [4, 2] }\n[bodies.material]",
     "15: bodies[1].shape: needs exactly one of box, ball, capsule, cylinder, mesh, polygon, points; "
     "found box and ball"),
    ("shape.ball = { center = [3.0, 1.0], radius = 0.5 }", "shape = {}",
     "15: bodies[1].shape: needs exactly one of box, ball, capsule, cylinder, mesh, polygon, points; found none"),
    ("shape.ball = {", "shape.cylinder = {",
     "15: bodies[1].shape.cylinder: is a shape of 3D scenes and this one is 2D; use box, ball, capsule or polygon"),
    ("max = [1.0, 1.0]", "max = [1.0, 0.0]",
     "12: bodies[0].shape.box.max: must be above min along y, so that the box holds matter"),
    ("ball = { center = [3.0, 1.0], radius = 0.5 }", "polygon.vertices = [\n  [2, 1], [3, 2],\n  [3, 1],\n  [2, 2]]",
     "15: bodies[1].shape.polygon.vertices: the edges after vertices 0 and 2 cross or touch: "
     "list the vertices in order round the outline"),
    ("ball = { center = [3.0, 1.0], radius = 0.5 }", 'polygon.vertices = [\n  [2, 1], [3, 1],\n  [3, "2"],\n  [2, 2]]',
     '17: bodies[1].shape.polygon.vertices[2][1]: must be a number; found "2"'),
    ("max = [1.0, 1.0]", "max = [1.0, 2.05]",
     '12: bodies[0].shape: body "column" leaves the domain through y_max by 0.05 m '
     "(it reaches y = 2.05, the face is at 2); move it or enlarge the domain"),
    ("center = [3.0, 1.0]", "center = [1.2, 1.0]",
     '15: bodies[1].shape: body "drop" overlaps body "column", for example at [0.702459, 0.9525]; '
     "bodies may touch but not overlap"),
    ('"drop"', '"column"', '14: bodies[1].name: "column" is the name of bodies[0] already; every body needs its own'),
    ('"drop"', '"a.b"',
     '14: bodies[1].name: must begin with a letter and hold only letters, digits, spaces, - and _; found "a.b"'),
    ('name = "drop"', 'name = "drop"\nparticles_per_cell = 5',
     "15: bodies[1].particles_per_cell: must be a square number for a lattice in 2D, for example 4 or 9; "
     'found 5. With sampling = "jittered" any number will do'),
    ('name = "drop"', 'name = "drop"\nvelocity_gradient = [[1, 2]]',
     "15: bodies[1].velocity_gradient: needs two numbers in this 2D scene (as many as domain.size); found 1"),
    ('name = "drop"', 'name = "drop"\nvelocity = []',
     "15: bodies[1].velocity: needs two numbers in this 2D scene (as many as domain.size); found 0"),
    ("[time]", '[output]\nfields = ["pressur"]\n[time]',
     f'7: output.fields[0]: must be {listed(FIELD_NAMES)}; found "pressur"; did you mean "pressure"?'),
    ("[time]", '[output]\nfields = ["mass", "mass"]\n[time]',
     '7: output.fields: lists "mass" more than once; once is enough'),
    ("[time]", '[output]\nfields = [\n  "mass",\n  "plastic_strain"]\n[time]',
     '9: output.fields[1]: no body of this 2D scene stores "plastic_strain"; it can store velocity, density, '
     "pressure, volume_ratio, deformation_gradient, affine, stress, mass and initial_position"),
    ("[time]", "[output]\ncompress = 1\n[time]", "7: output.compress: must be true or false; found 1"),
    ("spacing = 0.02", "spacing =",
     "4:10: not valid TOML: this is not a TOML value; text needs quotes, numbers and lists none"),
    ("box = { min", "box = {\nmin", "12:18: not valid TOML: expected a key; a table in { } stands on one line"),
    ("spacing = 0.02", "spacing 0.02", "4:9: not valid TOML: expected key = value"),
    ('[[bodies]]\nname = "drop"', '[bodies]\nname = "drop"',
     "13:8: not valid TOML: [bodies] and [[bodies]] are both given; write [[bodies]] for each entry"),
    ('[[bodies]]\nname = "column"', '[bodies]\nname = "column"',
     "13:9: not valid TOML: [bodies] and [[bodies]] are both given; write [[bodies]] for each entry"),
    ("[time]", "[[domain]]\n[time]",
     "6:9: not valid TOML: [domain] and [[domain]] are both given; write [domain] once"),
    ("[time]", "[domain]\n[time]", "6:8: not valid TOML: domain is given twice"),
    ("[time]", "[[time]]", "6: time: must be one table: write [time] or time = { ... }; found a list"),
    ("[time]", '[colliders]\nname = "a"\n[time]',
     "6: colliders: must be a list of tables: write [[colliders]] for each entry; found a table with name"),
    ('law = "neo_hookean"', 'law = "sand"\nfriction_angle = 0',
     "18: bodies[1].material.friction_angle: must be greater than 0; for a material without friction take "
     'law = "von_mises" with a yield_stress of 1.73 times its cohesion; found 0'),
    ('law = "neo_hookean"', 'law = "sand"\nrepose_angle = 0.0',
     "18: bodies[1].material.repose_angle: must be greater than 0; for a material without friction take "
     'law = "von_mises" with a yield_stress of 1.73 times its cohesion; found 0.0'),
]  # fmt: skip


@pytest.mark.parametrize(("good", "bad", "line"), REPLACED, ids=[line.split(":", 2)[-1][:50] for *_, line in REPLACED])
def test_each_bad_scene_has_its_sentence(good, bad, line):
    assert good in GOOD
    assert refusal(GOOD.replace(good, bad)) == [f"scene.toml:{line}"]


def tables_in(tree: Any) -> Iterator[dict]:
    """Yield each table of parsed TOML."""
    if isinstance(tree, dict):
        yield tree
    for inner in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from tables_in(inner)


@pytest.mark.parametrize("name", ["paddle_wheel_2d", "shaken_tank_2d", "fountain_2d", "jelly_stack_3d"])
def test_an_unknown_key_of_any_table_is_answered_by_the_known_ones(name: str) -> None:
    """In all tables of some examples but [constants], which takes any key, and materials, which name parameters."""
    path = examples()[name]
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    for table in tables_in(data):
        if table is data.get("constants"):
            continue
        table["qqqq"] = 1
        with pytest.raises(InputError) as refused:
            parse_scene(data, laws=parameter_models(), directory=path.parent)
        del table["qqqq"]
        (line,) = str(refused.value).splitlines()
        assert "the keys here are " in line or "its parameters are " in line or "has no parameter" in line
        assert line[-1].isalnum()
