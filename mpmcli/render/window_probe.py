"""Draws one point in a window of VTK and looks for it in the picture; a process of its own, since VTK may end it.

    python -m mpmcli.render.window_probe [CLASS]

It answers {"window": class that came, "renderer": ..., "version": ...}, of OpenGL, or {"problem": "a sentence"}; also
where another class than CLASS came. VTK_DEFAULT_OPENGL_WINDOW says which one VTK is to take.
"""

import sys

from mpmcli.processes.questions import answering

SIZE = 32
POINT_SIZE = 9
RED, BLUE = (255, 0, 0), (0, 0, 255)
# A device may round; nothing that draws this point in this colour is further off.
COLOR_TOLERANCE = 8
NO_VTK = "VTK cannot be loaded"


def draw_point(wanted: str | None) -> dict[str, str]:
    """Draw a red point on blue, and return what window and device drew it, or what is wrong.

    Args:
        wanted: the class that the window has to have, None for any.
    """
    try:
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401 (brings the classes that draw)
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow
    except ImportError as error:
        return {"problem": f"{NO_VTK} ({error})"}
    window = vtkRenderWindow()
    came = window.GetClassName()
    # Where none opens VTK hands out one that crashes as soon as it draws.
    if wanted is not None and came != wanted:
        return {"problem": "does not open"}
    points, vertices, cloud = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.InsertNextPoint(0.0, 0.0, 0.0)
    vertices.InsertNextCell(1)
    vertices.InsertCellPoint(0)
    cloud.SetPoints(points)
    cloud.SetVerts(vertices)
    mapper, actor, renderer = vtkPolyDataMapper(), vtkActor(), vtkRenderer()
    mapper.SetInputData(cloud)
    actor.SetMapper(mapper)
    actor.GetProperty().SetPointSize(POINT_SIZE)
    actor.GetProperty().SetColor(1.0, 0.0, 0.0)
    actor.GetProperty().LightingOff()
    renderer.SetBackground(0.0, 0.0, 1.0)
    renderer.AddActor(actor)
    renderer.ResetCamera(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(SIZE, SIZE)
    window.AddRenderer(renderer)
    window.Render()
    problem = picture_problem(_pixel(window, SIZE // 2), _pixel(window, 1))
    if problem:
        return {"problem": problem}
    said = window.ReportCapabilities()
    return {"window": came, "renderer": _told(said, "renderer"), "version": _told(said, "version")}


def picture_problem(middle: tuple[int, ...], corner: tuple[int, ...]) -> str:
    """Return what is wrong with the colours, 0 to 255, of the point and of its background; "" for nothing."""
    if _alike(middle, RED) and _alike(corner, BLUE):
        return ""
    return f"draws {middle} on {corner} instead of {RED} on {BLUE}"


def _pixel(window: object, place: int) -> tuple[int, ...]:
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    values = vtkUnsignedCharArray()
    window.GetPixelData(place, place, place, place, 0, values, 0)
    return tuple(int(values.GetValue(channel)) for channel in range(values.GetNumberOfValues()))


def _alike(color: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return len(color) == 3 and all(abs(a - b) <= COLOR_TOLERANCE for a, b in zip(color, wanted, strict=True))


def _told(capabilities: str, name: str) -> str:
    mark = f"OpenGL {name} string:"
    return next((line[len(mark) :].strip() for line in capabilities.splitlines() if line.startswith(mark)), "")


if __name__ == "__main__":
    with answering() as answer:
        answer(**draw_point(sys.argv[1] if len(sys.argv) > 1 else None))
