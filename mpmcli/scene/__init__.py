"""Scenes: the description of a simulation, read from TOML, validated, and sampled with particles."""

from mpmcli.scene.bounds import highest_speed, scene_bounds
from mpmcli.scene.domain import Domain
from mpmcli.scene.expand import json_schema
from mpmcli.scene.load import LoadedScene, load_scene, parse_scene
from mpmcli.scene.material import SceneBounds
from mpmcli.scene.sampling import BodyParticles, estimate_particles, sample_bodies
from mpmcli.scene.schema import Body, Scene, SolverSettings
from mpmcli.scene.toml_file import scene_to_toml

__all__ = [
    "Body",
    "BodyParticles",
    "Domain",
    "LoadedScene",
    "Scene",
    "SceneBounds",
    "SolverSettings",
    "estimate_particles",
    "highest_speed",
    "json_schema",
    "load_scene",
    "parse_scene",
    "sample_bodies",
    "scene_bounds",
    "scene_to_toml",
]
