"""Draws 3D surfaces in one off-screen window whose meshes are replaced with every frame."""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from mpmcli.frames.frame import Frame
from mpmcli.render import lighting
from mpmcli.render.colliders import ColliderMesh, collider_meshes, edge_actors
from mpmcli.render.coloring import Coloring
from mpmcli.render.occlusion import Background, Occlusion, occlusion_by
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.particle_grid import blurred_along, deposited
from mpmcli.render.reconstruction import group_mesh
from mpmcli.render.render_scene import Appearance, Group, RenderScene, SharedGeometry, groups_of
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import View

# Pixels of the window per pixel of the picture, along each axis, and the longest side of a window.
FINER, LONGEST = 2, 8192
# Edge of the cells for the thickness of a body, in distances between particles, and the smallest edge, pixels.
COARSENESS, FINEST = 1.4, 3.0
# Radius of the ball of a grain, in distances between particles: slightly above half, so that a heap has no holes.
RADIUS = 0.6
VARIETY = 0.26  # relative variation of brightness of grains
JITTER = 0.3  # random displacement of a grain, in distances between particles, because heaps are not lattices


class SurfaceRenderer:
    """Draws the materials of a 3D run as bodies against a lit background."""

    def __init__(
        self,
        scene: RenderScene,
        view: View,
        theme: Theme,
        colors: Coloring | None = None,
        shared: SharedGeometry | None = None,
    ) -> None:
        """Prepare the window, its background and the surfaces of colliders."""
        self.shared = shared or SharedGeometry()
        self.scene, self.view, self.theme, self.colors = scene, view, theme, colors
        self.fields = () if colors is None else colors.fields
        self.background = Background(scene, view, theme)
        self.lamp = lighting.lights_of(scene, view, theme)["lampTo"]
        self.window = OffscreenRenderer(view, theme, samples=FINER if FINER * max(view.size) <= LONGEST else 1)
        self.window.add_box(scene, width=1.3)
        self.renderer = self.window.plotter.renderer
        self.behind, self.background_texture = (_texture(self.background.image(None)) for _ in range(2))
        self.renderer.SetBackgroundTexture(self.background_texture)
        self.renderer.TexturedBackgroundOn()
        self.actors: dict[Any, Any] = {}
        self.rims: dict[int, list[Any]] = {}
        self.solids = [(mesh, mesh.shown(fine=True)) for mesh in collider_meshes(scene)]

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        groups = groups_of(self.scene, frame)
        solids = [(mesh, shown) for mesh, shown in self.solids if self.scene.shows(mesh.number, frame)]
        shades = [mesh.shade(frame.time) for mesh, _ in solids if mesh.casts]
        lamp = self.lamp
        key = ("occlusion", *lamp.tolist())
        occlusion = self.shared.once(frame, key, lambda: occlusion_by(self.scene, groups, lamp, shades))
        clear = []
        for actor in (*self.actors.values(), *chain(*self.rims.values())):
            actor.SetVisibility(False)
        for group in groups:
            actor = self._posed(group, frame, occlusion)
            if group.appearance.finish in lighting.CLEAR and self.colors is None:
                clear.append(actor)
        for mesh, shown in solids:
            self._pose_solid(mesh, shown, frame.time, occlusion)
        _put(self.background_texture, self.background.image(occlusion))
        if clear:
            # Clear bodies show the picture of all others.
            for actor in clear:
                actor.SetVisibility(False)
            self.window.render()
            # Its depth from 0, near, to 255, far and nothing.
            share = (self.window.depth() - self.view.near) / (self.view.far - self.view.near)
            nearness = (255 * np.clip(share, 0, 1)).astype(np.uint8)
            _put(self.behind, np.dstack([self.window.pixels(), nearness]))
            for actor in clear:
                actor.SetVisibility(True)
        self.window.render()
        return self.window.picture()

    def _posed(self, group: Group, frame: Frame, occlusion: Occlusion) -> Any:
        """Return the actor of a group, with the mesh of this frame."""
        finish = group.appearance.finish
        if finish == "grains":
            return self._posed_grains(group, frame, occlusion)
        attributes = {"rough": group.hashes} if finish == "crumbly" or group.appearance.name == "lava" else {}
        if self.colors is not None:
            values = np.asarray(self.colors.values(frame), dtype=np.float64)[group.rows]
            known = np.isfinite(values)
            attributes |= {"value": np.where(known, values, 0.0), "known": known.astype(np.float32)}
        mesh = group_mesh(self.scene, group, attributes, self.shared, frame)
        if group.key not in self.actors:
            self.actors[group.key] = self._new_actor(group.appearance, by_field=self.colors is not None)
        tint = lighting.linear(group.appearance.color)
        if self.colors is not None:
            value, known = (mesh.attributes[name].astype(np.float64) for name in ("value", "known"))
            # The mean over the particles with a number, if they are the majority.
            mean = np.divide(value, known, out=np.full_like(value, np.nan), where=known > 0.5)
            tint = (self.colors.rgb(mean) / 255.0) ** 2.2
        thick = 0.0
        if finish in lighting.CLEAR:
            thick = _thickness_at(self.view, group.position, group.distance, mesh.points)
        looks = tint, thick, mesh.attributes.get("rough", 0.0)
        return _carry(self.actors[group.key], occlusion, mesh.points, mesh.triangles, mesh.normals, looks)

    def _posed_grains(self, group: Group, frame: Frame, occlusion: Occlusion) -> Any:
        """Return the actor of a group of loose grains: balls for particles, each slightly lighter or darker."""
        import pyvista as pv

        if group.key not in self.actors:
            self.actors[group.key] = _new_grains(self.view, self.lamp, group.distance)
            self.renderer.AddActor(self.actors[group.key])
        actor = self.actors[group.key]
        color, hashes = np.array(rgb(group.appearance.color)), group.hashes
        if self.colors is not None:
            color = self.colors.particle_rgb(frame)[group.rows] / 255.0
            # A colour that represents a value is not varied.
            hashes = np.zeros_like(hashes)
        lamp, sky = occlusion.at(group.position, np.array(self.scene.up))
        light = 0.42 + 0.34 * lamp + 0.30 * sky
        light = light * (1.0 + VARIETY * hashes[:, 0] * np.abs(hashes[:, 0]) + 0.08 * hashes[:, 1])
        shown = np.clip(np.broadcast_to(color, hashes.shape) * light[:, None], 0.0, 1.0)
        cloud = pv.PolyData(grain_places(self.scene, group).astype(np.float32))
        cloud.point_data["colors"] = (255.0 * shown + 0.5).astype(np.uint8)
        mapper = actor.GetMapper()
        mapper.SetInputData(cloud)
        mapper.SetScalarModeToUsePointFieldData()
        mapper.SelectColorArray("colors")
        mapper.SetColorModeToDirectScalars()
        actor.SetVisibility(True)
        return actor

    def _pose_solid(self, mesh: ColliderMesh, shown: Any, time: float, occlusion: Occlusion) -> None:
        """Move a collider to its position at a time, s, and light it."""
        color, key, matrix = self.theme.solid, ("collider", mesh.number), mesh.transform(time)
        if key not in self.actors:
            look = Appearance("collider", color, color, "matte")
            self.actors[key] = self._new_actor(look, by_field=False, walled=False)
            if self.scene.clear and mesh.casts:
                self.actors[key].GetProperty().BackfaceCullingOff()
                self.actors[key].GetProperty().FrontfaceCullingOn()
            # The rims of a container represent its near side, which is invisible.
            inside = mesh.collider.side == "inside"
            self.rims[mesh.number] = edge_actors(mesh, self.theme, self.window) if inside else []
        for rim in self.rims[mesh.number]:
            rim.user_matrix = matrix
            rim.SetVisibility(True)
        normals = shown.point_data["Normals"] @ matrix[:3, :3].T
        points = shown.points @ matrix[:3, :3].T + matrix[:3, 3]
        _carry(self.actors[key], occlusion, points, shown.regular_faces, normals, (lighting.linear(color), 0.0, 0.0))

    def _new_actor(self, appearance: Appearance, *, by_field: bool, walled: bool = True) -> Any:
        """Return an actor, added to the renderer, with the shaders of an appearance, or of a field, `by_field`."""
        import vtk

        mapper = vtk.vtkPolyDataMapper()
        mapper.ScalarVisibilityOff()
        # The shader uses metres.
        mapper.SetVBOShiftScaleMethod(0)
        for name in lighting.CARRIED:
            mapper.MapDataArrayToVertexAttribute(name, name, 0, -1)
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().BackfaceCullingOn()
        actor.GetProperty().SetTexture(lighting.BEHIND, self.behind)
        shader = actor.GetShaderProperty()
        declared, done = lighting.vertex_code()
        shader.AddVertexShaderReplacement("//VTK::Normal::Dec", True, f"//VTK::Normal::Dec\n{declared}", False)
        shader.AddVertexShaderReplacement("//VTK::Normal::Impl", True, f"//VTK::Normal::Impl\n{done}", False)
        declared, done = lighting.fragment_code(
            self.scene, self.view, self.theme, appearance, self.window.samples, by_field=by_field, walled=walled
        )
        # After the window's own code; its lights and textures are left out.
        shader.AddFragmentShaderReplacement("//VTK::TCoord::Dec", True, f"//VTK::TCoord::Dec\n{declared}", False)
        shader.AddFragmentShaderReplacement("//VTK::Light::Impl", True, "", False)
        shader.AddFragmentShaderReplacement("//VTK::TCoord::Impl", True, done, False)
        self.renderer.AddActor(actor)
        return actor


def grain_places(scene: RenderScene, group: Group) -> np.ndarray:
    """Return where the balls of grains are drawn, (n, 3), m."""
    moved = group.position + JITTER * group.distance * group.hashes[:, ::-1]
    return np.clip(moved, scene.lower, scene.upper)


def _carry(
    actor: Any,
    occlusion: Occlusion,
    points: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray,
    looks: Sequence[Any],
) -> Any:
    """Give an actor a mesh whose vertices pass light, tint, thickness and roughness, the `looks`, to the shader."""
    import pyvista as pv

    data = pv.PolyData.from_regular_faces(points, triangles) if len(points) else pv.PolyData()
    tint, thick, rough = looks
    light = np.zeros((len(points), 4), dtype=np.float32)
    light[:, :2] = np.transpose(occlusion.at(points, normals))
    light[:, 2] = thick
    for name, values in zip(lighting.CARRIED, (light, tint, rough, normals), strict=True):
        columns = 4 if name == lighting.LIGHT else 3
        data.point_data[name] = np.array(np.broadcast_to(values, (len(points), columns)), dtype=np.float32)
    # Needed only because the window declares textures for meshes with these coordinates.
    data.point_data["places"] = np.zeros((len(points), 2), dtype=np.float32)
    data.GetPointData().SetActiveTCoords("places")
    actor.GetMapper().SetInputData(data)
    actor.SetVisibility(bool(len(triangles)))
    return actor


def _thickness_at(view: View, position: np.ndarray, distance: float, points: np.ndarray) -> np.ndarray:
    """Return the length (v,) of a body along a ray through each of the points (v, 3), m.

    Particles (n, 3) are counted in coarse cells of the picture: their volume over the area of a cell at their depth.
    """
    seen, wanted = view.pixels(position), view.pixels(points)
    edge = max(FINEST, COARSENESS * distance * float(np.median(view.scale_at(seen[:, 2]))))
    shape = (math.ceil(view.size[1] / edge) + 2, math.ceil(view.size[0] / edge) + 2)
    area = (edge / view.scale_at(seen[:, 2])) ** 2
    total = deposited(seen[:, :2] / edge + 0.5, distance**3 / area, shape)
    total = blurred_along(blurred_along(total, 0), 1)
    return map_coordinates(total, wanted[:, 1::-1].T / edge + 0.5, order=1, mode="nearest")


def _texture(picture: np.ndarray) -> Any:
    import pyvista as pv

    texture = pv.Texture(picture)
    texture.mipmap, texture.interpolate = False, True
    texture.wrap = pv.Texture.WrapType.CLAMP_TO_EDGE
    return texture


def _put(texture: Any, picture: np.ndarray) -> None:
    import pyvista as pv

    texture.SetInputDataObject(pv.Texture(picture).to_image())


def _new_grains(view: View, lamp: np.ndarray, distance: float) -> Any:
    """Return an actor without grains, whose balls are lit by the lamp."""
    import vtk

    mapper = vtk.vtkPointGaussianMapper()
    mapper.SetInputData(vtk.vtkPolyData())
    mapper.EmissiveOff()
    mapper.SetScaleFactor(RADIUS * distance)
    right, up, back = (float(lamp @ axis) for axis in view.axes)
    lamp = f"vec3({right:.6f}, {up:.6f}, {back:.6f})"
    mapper.SetSplatShaderCode(lighting.shader_parts()["grain"].replace("LAMP", lamp))
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    return actor
