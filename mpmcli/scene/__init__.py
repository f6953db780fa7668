"""Scenes: the description of a simulation, read from TOML, validated, and sampled with particles."""

from mpmcli.scene.bounds import highest_speed, scene_bounds
from mpmcli.scene.catalogue import json_schema
from mpmcli.scene.domain import Domain, Wall, Walls
from mpmcli.scene.load import LoadedScene, load_scene, parse_scene
from mpmcli.scene.material import MaterialParameters, SceneBounds
from mpmcli.scene.sampling import BodyParticles, estimate_particles, sample_bodies
from mpmcli.scene.schema import Body, Output, ParticleField, Scene, SolverSettings, Time, scene_model
from mpmcli.scene.shapes import Ball, Box, Capsule, Cylinder, Polygon, Shape
from mpmcli.scene.toml_file import scene_to_toml

__all__ = [
    "Ball",
    "Body",
    "BodyParticles",
    "Box",
    "Capsule",
    "Cylinder",
    "Domain",
    "LoadedScene",
    "MaterialParameters",
    "Output",
    "ParticleField",
    "Polygon",
    "Scene",
    "SceneBounds",
    "Shape",
    "SolverSettings",
    "Time",
    "Wall",
    "Walls",
    "estimate_particles",
    "highest_speed",
    "json_schema",
    "load_scene",
    "parse_scene",
    "sample_bodies",
    "scene_bounds",
    "scene_model",
    "scene_to_toml",
]
