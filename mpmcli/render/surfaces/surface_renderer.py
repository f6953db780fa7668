"""Draws 3D surfaces in one off-screen window, its meshes replaced with every frame."""

import math
from itertools import chain
from typing import Any

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.appearance import Appearance
from mpmcli.render.collider_actors import edge_actors
from mpmcli.render.collider_mesh import ColliderMesh, collider_meshes
from mpmcli.render.coloring import Coloring
from mpmcli.render.offscreen import averaged, window_pixels
from mpmcli.render.particle_grid import blurred_along, deposited, sampled
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.shading import lighting
from mpmcli.render.shading.background import Background
from mpmcli.render.shading.material_groups import Group, groups_of
from mpmcli.render.shading.occlusion import Occlusion
from mpmcli.render.surfaces.grains import JITTER, grain_colors, new_grains, pose_grains
from mpmcli.render.surfaces.reconstruction import SMOOTHING_ROUNDS, Mesh, reconstruct
from mpmcli.render.theme import Theme, rgb
from mpmcli.render.view import View

# Pixels of the window to one of the picture, along each axis, and the longest side of a window.
FINER, LONGEST = 2, 8192
# Rounds of smoothing, by finish; crumbs keep their lumps.
ROUNDS = {"crumbly": 2}
# Edge of the cells in which the thickness of a body is found, in distances between particles, and the least, pixels.
COARSENESS, FINEST = 1.4, 3.0


class SurfaceRenderer:
    """Draws the materials of a 3D run as bodies against a lit background.

    Attributes:
        fields: that are read of each frame.
    """

    def __init__(self, scene: RenderScene, view: View, theme: Theme, colors: Coloring | None = None) -> None:
        """Open the window; nothing is drawn yet."""
        import pyvista as pv

        self.scene, self.view, self.theme, self.colors = scene, view, theme, colors
        self.fields = () if colors is None else colors.fields
        self.background = Background(scene, view, theme)
        self.lights = lighting.lights_of(scene, view, theme)
        self.finer = FINER if FINER * max(view.size) <= LONGEST else 1
        self.plotter = pv.Plotter(off_screen=True, window_size=[self.finer * n for n in view.size], lighting="none")
        self.plotter.disable_anti_aliasing()
        self.behind, self.background_texture = _texture(), _texture()
        for texture in (self.behind, self.background_texture):
            _put(texture, self.background.image(None))
        self.plotter.renderer.SetBackgroundTexture(self.background_texture)
        self.plotter.renderer.TexturedBackgroundOn()
        self.actors: dict[Any, Any] = {}
        self._add_walls()
        self.rims: dict[int, list[Any]] = {}
        self.solids = [(mesh, mesh.shown(fine=True)) for mesh in collider_meshes(scene)]
        view.place(self.plotter)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        groups = groups_of(self.scene, frame)
        solids = [(mesh, shown) for mesh, shown in self.solids if self.scene.shows(mesh.number, frame)]
        shades = [mesh.shade(frame.time) for mesh, _ in solids if mesh.casts]
        occlusion = lighting.occlusion_by(self.scene, groups, self.lights.lamp, shades)
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
            # What is clear shows the picture of all the rest.
            for actor in clear:
                actor.SetVisibility(False)
            _put(self.behind, self._window_pixels())
            for actor in clear:
                actor.SetVisibility(True)
        return averaged(self._window_pixels(), self.finer)

    def _window_pixels(self) -> np.ndarray:
        self.view.place(self.plotter)
        self.plotter.render_window.Render()
        return window_pixels(self.plotter.render_window)

    def _posed(self, group: Group, frame: Frame, occlusion: Occlusion | None) -> Any:
        """Return the actor of a group, with the mesh of this frame."""
        if group.appearance.finish == "grains":
            return self._posed_grains(group, frame, occlusion)
        attributes = (
            {"rough": group.hashes} if group.appearance.finish == "crumbly" or group.appearance.name == "lava" else {}
        )
        if self.colors is not None:
            values = np.asarray(self.colors.values(frame), dtype=np.float64)[group.rows]
            known = np.isfinite(values)
            attributes |= {"value": np.where(known, values, 0.0), "known": known.astype(np.float32)}
        mesh = reconstruct(
            group.position,
            group.distance,
            self.scene.lower,
            self.scene.upper,
            attributes,
            rounds=ROUNDS.get(group.appearance.finish, SMOOTHING_ROUNDS),
            close=group.appearance.finish == "crumbly",
        )
        actor = self.actors.get(group.key)
        if actor is None:
            actor = self.actors[group.key] = self._new_actor(group.appearance, by_field=self.colors is not None)
        self._fill(actor, mesh, group, occlusion)
        actor.SetVisibility(bool(len(mesh.triangles)))
        return actor

    def _posed_grains(self, group: Group, frame: Frame, occlusion: Occlusion | None) -> Any:
        actor = self.actors.get(group.key)
        if actor is None:
            actor = self.actors[group.key] = new_grains(self.view, self.lights, group.distance)
            self.plotter.renderer.AddActor(actor)
        color = np.array(rgb(group.appearance.color))
        hashes = group.hashes
        if self.colors is not None:
            color = self.colors.shades(np.asarray(self.colors.values(frame), dtype=np.float64)[group.rows])
            # A colour that means something is not varied.
            hashes = np.zeros_like(hashes)
        lamp, sky = np.ones((2, len(hashes)))
        if occlusion is not None:
            lamp, sky = occlusion.at(group.position, np.broadcast_to(self.scene.up, group.position.shape))
        moved = np.clip(
            group.position + JITTER * group.distance * group.hashes[:, ::-1], self.scene.lower, self.scene.upper
        )
        pose_grains(actor, moved, grain_colors(color, hashes, lamp, sky))
        actor.SetVisibility(True)
        return actor

    def _pose_solid(self, mesh: ColliderMesh, shown: Any, time: float, occlusion: Occlusion | None) -> None:
        """Put a collider where it is at a time, s, in the light there."""
        color = self.theme.solid
        number = mesh.number
        key = ("collider", number)
        actor = self.actors.get(key)
        matrix = mesh.transform(time)
        if actor is None:
            look = Appearance("collider", color, color, "matte")
            actor = self.actors[key] = self._new_actor(look, by_field=False, walled=False)
            if self.scene.clear and mesh.casts:
                actor.GetProperty().BackfaceCullingOff()
                actor.GetProperty().FrontfaceCullingOn()
            # The rims of a container stand for its near side, which is not seen.
            inside = mesh.collider.side == "inside"
            self.rims[number] = edge_actors(mesh, self.theme, self.plotter, self.finer) if inside else []
        for rim in self.rims[number]:
            rim.user_matrix = matrix
            rim.SetVisibility(True)
        normals = shown.point_data["Normals"] @ matrix[:3, :3].T
        points = shown.points @ matrix[:3, :3].T + matrix[:3, 3]
        light = np.ones((len(points), 4), dtype=np.float32)
        if occlusion is not None:
            light[:, 0], light[:, 1] = occlusion.at(points, normals)
        tint = np.broadcast_to(lighting.linear(color), points.shape)
        _carry(actor, points, shown.regular_faces, (light, tint, np.zeros_like(points), normals))
        actor.SetVisibility(True)

    def _fill(self, actor: Any, mesh: Mesh, group: Group, occlusion: Occlusion | None) -> None:
        count = len(mesh.points)
        light = np.ones((count, 4), dtype=np.float32)
        if occlusion is not None and count:
            light[:, 0], light[:, 1] = occlusion.at(mesh.points, mesh.normals)
            if group.appearance.finish in lighting.CLEAR:
                light[:, 2] = _thickness_at(self.view, group.position, group.distance, mesh.points)
        tint = np.broadcast_to(lighting.linear(group.appearance.color), (count, 3))
        if self.colors is not None:
            value, known = mesh.attributes["value"].astype(np.float64), mesh.attributes["known"].astype(np.float64)
            # The mean over those particles that have a number, where they are the majority.
            mean = np.divide(value, known, out=np.full_like(value, np.nan), where=known > 0.5)
            tint = self.colors.shades(mean) ** np.float32(2.2)
        rough = mesh.attributes.get("rough", np.zeros((count, 3), dtype=np.float32))
        _carry(actor, mesh.points, mesh.triangles, (light, tint, rough, mesh.normals))

    def _new_actor(self, appearance: Appearance, *, by_field: bool, walled: bool = True) -> Any:
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
            self.scene, self.view, self.lights, appearance, self.finer, by_field=by_field, walled=walled
        )
        # After all that the window does itself; its own lights and textures are left out.
        shader.AddFragmentShaderReplacement("//VTK::TCoord::Dec", True, f"//VTK::TCoord::Dec\n{declared}", False)
        shader.AddFragmentShaderReplacement("//VTK::Light::Impl", True, "", False)
        shader.AddFragmentShaderReplacement("//VTK::TCoord::Impl", True, done, False)
        self.plotter.renderer.AddActor(actor)
        return actor

    def _add_walls(self) -> None:
        import pyvista as pv

        low, high = self.scene.lower, self.scene.upper
        box = pv.Box(bounds=(low[0], high[0], low[1], high[1], low[2], high[2]))
        walls = self.plotter.add_mesh(
            box.extract_all_edges(),
            color=rgb(self.theme.wall),
            line_width=1.3 * self.finer,
            opacity=1.0,
            lighting=False,
        )
        walls.SetPickable(False)


def _carry(actor: Any, points: np.ndarray, triangles: np.ndarray, carried: tuple[np.ndarray, ...]) -> None:
    """Give an actor a mesh whose vertices hand the values of `lighting.CARRIED` to the shader."""
    import pyvista as pv

    data = pv.PolyData.from_regular_faces(points, triangles) if len(points) else pv.PolyData()
    for name, values in zip(lighting.CARRIED, carried, strict=True):
        data.point_data[name] = np.ascontiguousarray(values, dtype=np.float32)
    # Only because the window declares textures of meshes that have these.
    data.point_data["places"] = np.zeros((len(points), 2), dtype=np.float32)
    data.GetPointData().SetActiveTCoords("places")
    actor.GetMapper().SetInputData(data)


def _thickness_at(view: View, position: np.ndarray, distance: float, points: np.ndarray) -> np.ndarray:
    """Return the length (v,) of body that a ray through each of the points (v, 3) meets, m.

    Particles (n, 3) are counted in coarse cells of the picture: their volume over the area of a cell at their depth.
    """
    seen, wanted = view.pixels(position), view.pixels(points)
    near = max(float(seen[:, 2].mean()), 1e-12)
    scale = view.pixels_per_metre * (1.0 if view.parallel else view.distance / near)
    edge = max(FINEST, COARSENESS * distance * scale)
    shape = (math.ceil(view.size[1] / edge) + 2, math.ceil(view.size[0] / edge) + 2)
    area = (edge / view.pixels_per_metre) ** 2
    if not view.parallel:
        area = area * (seen[:, 2] / view.distance) ** 2
    total = deposited(seen[:, :2] / edge + 0.5, np.broadcast_to(distance**3 / area, len(seen)), shape)
    for axis in (0, 1):
        total = blurred_along(total, axis)
    return sampled(total, wanted[:, 1] / edge + 1.0, wanted[:, 0] / edge + 1.0)[:, 0]


def _texture() -> Any:
    import vtk

    texture = vtk.vtkTexture()
    texture.SetInputData(vtk.vtkImageData())
    texture.SetColorModeToDirectScalars()
    texture.InterpolateOn()
    texture.MipmapOff()
    texture.RepeatOff()
    texture.EdgeClampOn()
    return texture


def _put(texture: Any, picture: np.ndarray) -> None:
    """Put a picture (h, w, 3) uint8 into a texture."""
    import vtk
    from vtkmodules.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    height, width = picture.shape[:2]
    image.SetDimensions(width, height, 1)
    image.GetPointData().SetScalars(numpy_to_vtk(picture[::-1].reshape(-1, 3), deep=True))
    texture.SetInputData(image)
