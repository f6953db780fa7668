"""Files of cameras: the tables of [[cameras]] by themselves, for scenes that have others or none."""

from typing import Any

from pydantic import Field, ValidationError

from mpmcli.errors import InputError
from mpmcli.scene.cameras import Camera, camera_problems
from mpmcli.scene.entry import definitions
from mpmcli.scene.load import report
from mpmcli.scene.problem import problems_of
from mpmcli.scene.quantity import Table


class CameraFile(Table):
    """The tables of a file of cameras."""

    cameras: tuple[Camera, ...] = Field(min_length=1, description="Cameras.")


def valid_cameras(
    tables: dict[str, Any], dimension: int, constants: Any, end: float, source: str, text: str
) -> tuple[Camera, ...]:
    """Return the cameras of the parsed tables of a file for a scene that ends at `end`, s; InputError: they are faulty.

    `source` is the name of the file, and `text` its TOML, for errors.
    """
    context = {"dimension": dimension, "constants": definitions(constants, dimension)[0]}
    try:
        cameras = CameraFile.model_validate(tables, context=context).cameras
        problems = list(camera_problems(cameras, end))
    except ValidationError as error:
        problems = problems_of(error, tables, CameraFile)
    if problems:
        raise InputError(report(problems, source, text))
    return cameras
