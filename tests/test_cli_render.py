"""`mpmcli render` as it is called: files, films, what is kept, what is refused in one sentence."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from command import run_here
from drawn_results import JELLY, WATER, frame, header, lattice, write
from PIL import Image

from mpmcli.materials.registry import parameter_models
from mpmcli.output import Result, open_result
from mpmcli.output.layout import SEGMENTS
from mpmcli.render.picture_file import settings_digest, write_picture
from mpmcli.render.render_scene import APPEARANCES, result_of_start
from mpmcli.render.request import Request, plan_render, speed_text
from mpmcli.render.settings import THEMES
from mpmcli.scene import load_scene

pytestmark = pytest.mark.usefixtures("drawing")

FRAMES = 6


def made(directory: Path, **options) -> Result:
    """A block of water that slides to the right under one of jelly; the pressure of one particle is not a number."""
    block = lattice((0.1, 0.1), (0.4, 0.3), 0.025)
    places = np.concatenate([block, block + np.array([0.0, 0.25])])
    body = np.repeat([0, 1], len(block))
    pressure = np.linspace(0.0, 1e4, len(places))
    pressure[5] = np.nan
    frames = [
        frame(k, places + np.array([0.08 * k, 0.0]), body, velocity=0 * places + k, pressure=pressure)
        for k in range(FRAMES)
    ]
    return write(directory, header((1.0, 0.6), 0.05, [WATER, JELLY]), frames, **options)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    made(tmp_path / "run")
    return tmp_path / "run"


def rendered(*arguments: object) -> dict:
    outcome = run_here("render", *arguments, "--size", "320x180", "--json", "--quiet")
    assert outcome.status == 0, outcome.stderr
    return json.loads(outcome.stdout)


def refused(*arguments: object) -> str:
    """The one sentence of bad input."""
    outcome = run_here("render", *arguments)
    assert outcome.status == 2 and outcome.stdout == "", outcome
    lines = outcome.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and lines[0].endswith("."), lines
    return lines[0]


def test_a_picture_of_the_last_frame_lies_beside_the_result(run: Path) -> None:
    said = rendered(run)
    assert said["pictures"] == [str(run / "render" / "dots_000005.png")] and said["made"] == 1
    with Image.open(said["pictures"][0]) as picture:
        assert picture.size == (320, 180)


SCENE_WITH_ALL = """\
domain = { size = [1.0, 0.6], spacing = 0.02 }
time = { end = 1.0, frames = 2 }
[[bodies]]
name = "block"
material = "jelly"
shape = { box = { min = [0.1, 0.1], max = [0.3, 0.3] } }
velocity = [1.0, 0.0]
[[emitters]]
name = "jet"
material = "water"
shape = { box = { min = [0.6, 0.4], max = [0.8, 0.5] } }
velocity = [0.0, -2.0]
[[colliders]]
name = "post"
shape = { box = { min = [0.8, 0.0], max = [0.9, 0.2] } }
"""


def test_a_scene_is_drawn_as_it_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies, the first layer of each emitter, colliders, and arrows as long as the speeds; nothing else is left.

    The layer is where it enters, two cells before the mouth.
    """
    monkeypatch.chdir(tmp_path)
    Path("start.toml").write_text(SCENE_WITH_ALL, encoding="utf-8")
    said = json.loads(run_here("render", "start.toml", "--workers", 1, "--json").stdout)
    assert said["pictures"] == ["start.png"] and sorted(tmp_path.iterdir()) == [
        tmp_path / "start.png",
        tmp_path / "start.toml",
    ]
    with Image.open("start.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)

    def near(color: str, within: int = 60) -> np.ndarray:
        wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
        return np.abs(pixels - wanted).max(axis=2) < within

    walls = near(THEMES["light"].wall)
    rows, columns = (np.flatnonzero(walls.sum(axis=axis) > 300) for axis in (1, 0))
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    # The legend is to the right of the walls.
    inside = np.arange(pixels.shape[1]) < right

    def place(row: float, column: float) -> tuple[float, float]:
        return (column - left) / (right - left), 0.6 * (bottom - row) / (bottom - top)

    jelly, water = (np.argwhere(near(APPEARANCES[name].ink) & inside) for name in ("jelly", "water"))
    assert place(*jelly.mean(axis=0)) == pytest.approx((0.2, 0.2), abs=0.01)
    assert place(*water.mean(axis=0)) == pytest.approx((0.7, 0.49), abs=0.01)
    assert np.ptp(water[:, 1]) / (right - left) == pytest.approx(0.2, abs=0.02)
    post = np.argwhere(near(THEMES["light"].solid) & inside & (np.arange(pixels.shape[0]) > top)[:, None])
    assert place(*np.median(post, axis=0)) == pytest.approx((0.85, 0.1), abs=0.02)
    # The jet's arrow begins where the jet enters and goes down by 0.15 m; the block's is half as long.
    dark = near(THEMES["light"].text, 20)
    column = round(left + 0.7 * (right - left))
    arrow = np.flatnonzero(dark[top + 10 : bottom - 10, column]) + top + 10
    # Its speed stands below.
    arrow = np.split(arrow, np.flatnonzero(np.diff(arrow) > 3) + 1)[0]
    assert place(arrow.max(), column)[1] == pytest.approx(0.34, abs=0.02)
    assert json.loads(run_here("render", "start.toml", "--json").stdout)["made"] == 0
    assert "--frame is for results" in refused("start.toml", "--frame", "first", "-o", "other.png")


TURNING = """
domain = { size = [1.0, 0.6, 0.5], spacing = 0.05 }
time = { end = 0.1, frames = 1 }
[[bodies]]
name = "drop"
material = "water"
shape = { box = { min = [0.8, 0.2, 0.2], max = [0.9, 0.3, 0.3] } }
[[colliders]]
name = "bar"
shape = { box = { min = [0.3, 0.2, 0.1], max = [0.7, 0.3, 0.4] } }
angular_velocity = 2.0
axis = [0.0, 2.0, 0.0]
"""


def test_what_turns_has_an_arrow_at_its_rim(tmp_path: Path) -> None:
    """The velocity of the rim is the spin times the arm; what is at rest has no arrow."""
    scene = tmp_path / "turning.toml"
    flat = TURNING.replace("axis = [0.0, 2.0, 0.0]", "")
    for numbers in ("1.0, 0.6, 0.5", "0.8, 0.2, 0.2", "0.9, 0.3, 0.3", "0.3, 0.2, 0.1", "0.7, 0.3, 0.4"):
        flat = flat.replace(numbers, numbers.rpartition(",")[0])
    for text, rim in ((TURNING, ((0.7, 0.25, 0.25), (0.0, 0.0, -1.0))), (flat, ((0.7, 0.25), (0.0, 1.0)))):
        scene.write_text(text, encoding="utf-8")
        with result_of_start(load_scene(scene, laws=parameter_models()).scene) as (_, arrows):
            ((place, direction, speed),) = arrows
        assert place == pytest.approx(rim[0]) and direction == pytest.approx(rim[1]) and speed == "0.4 m/s"


LOADED = """
domain = { size = [1.0, 0.6], spacing = 0.05 }
time = { end = 2.0, frames = 1 }
[[bodies]]
name = "bar"
material = "jelly"
shape = { box = { min = [0.2, 0.2], max = [0.8, 0.4] } }
[[colliders]]
name = "grip"
shape = { box = { min = [0.1, 0.1], max = [0.3, 0.5] } }
wall = "hold"
[[forces]]
body = "bar"
force = [0.0, "-25 * t"]
region = { box = { min = [0.7, 0.2], max = [0.8, 0.4] } }
[[forces]]
body = "bar"
acceleration = [5.0, 0.0]
[[forces]]
body = "bar"
acceleration = ["X - 0.5", 0.0]
"""


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_scene_of_rigid_bodies_alone_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dimension: int
) -> None:
    """A ball of which a fifth of the width of the domain is seen."""
    monkeypatch.chdir(tmp_path)
    domain = f"[domain]\nsize = {[1.0] * dimension}\nspacing = 0.05\n[time]\nend = 0.1\nframes = 1\n"
    ball = f"shape = {{ ball = {{ center = {[0.5] * dimension}, radius = 0.1 }} }}\n"
    Path("ball.toml").write_text(domain + '[[colliders]]\nname = "ball"\ndensity = 500.0\n' + ball, encoding="utf-8")
    assert run_here("render", "ball.toml", "--workers", 1).status == 0
    with Image.open("ball.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    assert np.abs(pixels[2, 2] - middle).max() > 20


def test_the_start_of_a_scene_shows_loads_and_held_parts(tmp_path: Path) -> None:
    """A force spread over a region acts at its centre; an acceleration is a force of m a; what cancels has no arrow."""
    scene = tmp_path / "loaded.toml"
    scene.write_text(LOADED, encoding="utf-8")
    loaded = load_scene(scene, laws=parameter_models()).scene
    with result_of_start(loaded) as (_, arrows):
        load, push = arrows
    weight = loaded.bodies[0].material.density * 0.6 * 0.2 * 5.0
    assert load[0] == pytest.approx((0.75, 0.3)) and load[2] == "50 N/m"
    assert push[0] == pytest.approx((0.5, 0.3)) and push[2] == f"{weight:.3g} N/m"
    assert push[1] == pytest.approx((1.0, 0.0)) and load[1] == pytest.approx((0.0, -50.0 / weight))
    shown = {}
    for colliders in ("solid", "none"):
        picture = tmp_path / f"{colliders}.png"
        run_here("render", scene, "-o", picture, "--colliders", colliders, "--workers", 1)
        with Image.open(picture) as image:
            shown[colliders] = np.asarray(image.convert("RGB")).astype(int)
    changed = np.argwhere(np.abs(shown["solid"] - shown["none"]).max(axis=2) > 0)
    walls = np.flatnonzero((np.abs(shown["none"] - [0x3F, 0x48, 0x56]).max(axis=2) < 9).sum(axis=0) > 300)
    metre = walls.max() - walls.min()
    height, width = np.ptp(changed, axis=0) / metre
    assert (width, height) == pytest.approx((0.2, 0.4), abs=0.01)
    assert 0.15 < len(changed) / (0.2 * 0.4 * metre**2) < 0.4


def test_stdout_gets_the_paths_that_were_asked_for(run: Path, tmp_path: Path) -> None:
    """Counts and warnings go to stderr, so that the output can be piped."""
    out, film, meshes = tmp_path / "out", tmp_path / "film.gif", tmp_path / "meshes"
    words = ["--frame", "0:2", "-o", out, "--size", "64x64", "--mode", "surface"]
    pictures = [f"{out / f'surface_{k:06d}.png'}" for k in range(2)]
    outcome = run_here("render", run, *words, "--workers", 1)
    assert outcome.stdout.splitlines() == pictures and outcome.stderr == "2 pictures made\n"
    outcome = run_here("render", run, *words, "--save-surface", meshes, "--workers", 1)
    assert outcome.stdout.splitlines() == [*pictures, str(meshes)]
    outcome = run_here("render", run, *words, "--movie", film, "--fps", 5)
    assert outcome.stdout == f"{film}\n"
    assert outcome.stderr.startswith("0 pictures made, 2 were there already; film: 5 frames per second, 1/")


def test_matplotlib_does_not_talk_in_between(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without a home it explains in several lines where it keeps its cache."""
    logging.getLogger("matplotlib").setLevel(logging.NOTSET)
    rendered(run)
    logging.getLogger("matplotlib.font_manager").warning("created a temporary cache directory")
    assert not caplog.records


def test_what_is_there_is_not_made_again_unless_something_changed(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = rendered(run, "-o", out, "--frame", "0:4", "--workers", 1)
    assert first["made"] == 4 and [Path(p).name for p in first["pictures"]] == [f"dots_{k:06d}.png" for k in range(4)]
    written = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    again = rendered(run, "-o", out, "--frame", "all", "--workers", 1)
    assert again["made"] == 2
    assert all(path.stat().st_mtime_ns == time for path, time in written.items())
    pixels = (out / "dots_000000.png").read_bytes()
    # Another setting is another picture; the same one again is the same, to the last byte.
    assert rendered(run, "-o", out, "--frame", 0, "--theme", "dark")["made"] == 1
    assert (out / "dots_000000.png").read_bytes() != pixels
    assert rendered(run, "-o", out, "--frame", 0)["made"] == 1
    assert (out / "dots_000000.png").read_bytes() == pixels
    assert rendered(run, "-o", out, "--frame", 0, "--overwrite")["made"] == 1
    assert (out / "dots_000000.png").read_bytes() == pixels


def test_several_processes_make_the_same_pictures(run: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        said = rendered(run, "-o", tmp_path / str(workers), "--frame", "0:2", "--workers", workers)
        assert said["made"] == 2
    for name in ("dots_000000.png", "dots_000001.png"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_a_film_has_its_frames_and_its_length(run: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    said = rendered(run, "--movie", film, "--fps", 12, "--workers", 1)
    assert said["film"] == str(film) and said["made"] == FRAMES
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert count == FRAMES and seconds == pytest.approx(FRAMES / 12, abs=0.02)
    facts = next(imageio_ffmpeg.read_frames(str(film)))
    assert facts["size"] == (320, 180) and facts["codec"].startswith("h264")
    # The same film of the same pictures is left alone; another rate makes another one of them.
    before = film.stat().st_mtime_ns
    assert rendered(run, "--movie", film, "--fps", 12)["made"] == 0
    assert film.stat().st_mtime_ns == before
    assert rendered(run, "--movie", film, "--fps", 24)["made"] == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(film))[1] == pytest.approx(FRAMES / 24, abs=0.02)


@pytest.mark.parametrize(
    ("pause", "fps", "name", "rate", "speed"),
    [
        (0.02, None, "film.mp4", 50, "in real time"),
        (0.04, None, "film.gif", 25, "in real time"),
        (0.02, 10, "film.mp4", 10, "1/5 of real time"),
        (0.0001, None, "film.mp4", 30, "1/333 of real time"),
        (0.0175, None, "film.gif", 30, "1/1.9 of real time"),
        (1.0, None, "film.mp4", 30, "30 times real time"),
        (0.0, None, "film.mp4", 30, "in real time"),
    ],
)
def test_a_film_keeps_the_time_of_its_scene(
    pause: float, fps: float | None, name: str, rate: float, speed: str
) -> None:
    times = pause * np.arange(5)
    found = Request(movie=Path(name), fps=fps).rate_of(times)
    assert found == pytest.approx(rate) and speed_text(found, times) == speed


def test_an_interrupt_ends_a_film_that_is_put_together(run: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    settings = Request(movie=film, output=tmp_path / "out", size="64x64")
    plan_render(open_result(run), replace(settings, movie=None, frames="all")).carry_out(1)
    with pytest.raises(KeyboardInterrupt):
        plan_render(open_result(run), settings).carry_out(1, stop=lambda: True)
    assert not film.exists() and len(list((tmp_path / "out").iterdir())) == FRAMES


def test_a_gif_is_read_by_another_reader(run: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.gif"
    rendered(run, "--movie", film, "--frame", "::2", "--fps", 10, "--workers", 1)
    with Image.open(film) as gif:
        assert gif.n_frames == 3 and gif.info["duration"] == 100 and gif.size == (320, 180)


def test_a_montage_is_one_picture_of_evenly_spaced_frames(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "montage.png"
    outcome = run_here("render", run, "-o", out, "--montage", "3x2", "--quiet")
    assert outcome.status == 0, outcome.stderr
    with Image.open(out) as picture:
        width, height = picture.size
        pixels = np.asarray(picture)
    assert width == 1280 and 300 < height < 900
    # Water moves to the right from frame to frame: its ink is in six places.
    blue = (pixels == (0x2F, 0x7F, 0xD0)).all(axis=2)
    blue[:, int(0.9 * width) :] = False  # the legend
    columns = blue.any(axis=0)
    assert np.count_nonzero(np.diff(columns.astype(int)) == 1) >= 3
    again = tmp_path / "again.png"
    run_here("render", run, "-o", again, "--montage", "3x2", "--quiet")
    assert out.read_bytes() == again.read_bytes()


def test_a_run_under_way_is_drawn_up_to_its_last_sealed_frame(tmp_path: Path) -> None:
    run = tmp_path / "run"
    made(run, finish=False)
    # A frame that is being written.
    (run / SEGMENTS / f"frame_{FRAMES:06d}.vtkhdf.tmp").write_bytes(b"half")
    assert (run / SEGMENTS).is_dir() and not (run / "particles.vtkhdf").exists()
    said = rendered(run, "--frame", "last")
    assert Path(said["pictures"][0]).name == f"dots_{FRAMES - 1:06d}.png"
    # It is not in the way of the run, which packs its frames in the end.
    assert "holds frames 0 to 5" in refused(run, "--frame", FRAMES)


def test_what_cannot_be_shown_as_it_is_is_said(run: Path) -> None:
    outcome = run_here("render", run, "--color-by", "pressure", "--size", "320x180", "--frame", 0)
    assert outcome.status == 0
    assert "warning: the pressure of 1 particle is not a number, first in frame 0" in outcome.stderr
    assert "#ff00c8" in outcome.stderr


def test_bad_input_gets_one_sentence_and_nothing_is_written(run: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.rglob("*"))
    assert "--frame 9: " in refused(run, "--frame", 9)
    assert 'stores no "density", but velocity and pressure' in refused(run, "--color-by", "density")
    assert "does not exist" in refused(tmp_path / "nowhere")
    assert "is not possible" in refused(run, "--size", "99999x99999")
    assert "is not a size" in refused(run, "--size", "big")
    assert "cannot be a film" in refused(run, "--movie", tmp_path / "film.avi")
    assert "frames per second" in refused(run, "--movie", tmp_path / "film.mp4", "--fps", 0)
    assert "name one with --movie" in refused(run, "--fps", 12)
    assert "exclude each other" in refused(run, "--movie", tmp_path / "film.mp4", "--montage", "2x2")
    assert "for a film, give --movie" in refused(run, "-o", tmp_path / "x.mp4")
    assert "name a directory" in refused(run, "-o", tmp_path / "x.png", "--frame", "all")
    assert "is not a colour map" in refused(run, "--color-by", "speed", "--cmap", "nonsense")
    assert "stand for a value" in refused(run, "--color-by", "material", "--clim", "0,1")
    assert "has its own colours" in refused(run, "--mode", "density", "--color-by", "speed")
    assert "drawn in its plane" in refused(run, "--camera", "side")
    assert "shows a slice" in refused(run, "--mode", "density", "--camera", "1,2,3,4,5,6")
    assert "--save-surface" in refused(run, "--save-surface", tmp_path / "s")
    assert sorted(tmp_path.rglob("*")) == before


def test_files_of_others_are_left_alone(run: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.png"
    Image.new("RGB", (10, 10)).save(mine)
    text = mine.read_bytes()
    assert "mpmcli render did not make it" in refused(run, "-o", mine)
    assert "mpmcli render did not make it" in refused(run, "-o", mine, "--montage", "2x2")
    film = tmp_path / "film.mp4"
    film.write_bytes(b"a film of mine")
    assert "mpmcli render did not make it" in refused(run, "--movie", film)
    assert mine.read_bytes() == text and film.read_bytes() == b"a film of mine"
    assert rendered(run, "-o", mine, "--overwrite")["made"] == 1
    # The picture of a ledger is no frame.
    write_picture(tmp_path / "ledger.png", np.zeros((5, 5, 3), np.uint8), "plot " + settings_digest({}))
    assert "mpmcli render did not make it" in refused(run, "-o", tmp_path / "ledger.png")
    (tmp_path / "file").write_text("no directory")
    assert "is a file, not a directory" in refused(run, "-o", tmp_path / "file", "--frame", "all")


def test_places_that_cannot_be_written_are_named(run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no directory")
    outcome = run_here("render", run, "-o", tmp_path / "file" / "x.png", "--size", "64x64")
    assert outcome.status == 2 and "cannot be written" in outcome.stderr and "Traceback" not in outcome.stderr


def test_without_a_window_the_setting_at_fault_is_named(run: Path, run_python: Callable) -> None:
    """VTK kills the interpreter where no window opens, as on a bare machine: another process has to find that out."""
    words = ["-m", "mpmcli", "render", run, "--size", "64x64"]
    done = run_python(words, check=False, environment={"VTK_DEFAULT_OPENGL_WINDOW": "nonsense"})
    assert done.status == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and "VTK_DEFAULT_OPENGL_WINDOW" in done.stderr
    assert not (run / "render").exists()


def test_surfaces_are_drawn_and_saved_for_other_tools(run: Path, tmp_path: Path) -> None:
    import pyvista as pv

    out, meshes = tmp_path / "out", tmp_path / "meshes"
    said = rendered(run, "--mode", "surface", "-o", out, "--frame", "0:2", "--save-surface", meshes, "--workers", 1)
    assert said["made"] == 2
    # The jelly is none of the presets, and goes by the name of its body.
    kinds = [(name, k, kind) for name in ("water", "body_1") for k in (0, 1) for kind in ("vtp", "obj")]
    names = {f"surface_{name}_{k:06d}.{kind}" for name, k, kind in kinds}
    assert {path.name for path in meshes.iterdir()} == names | {"surface_water.vtp.series", "surface_body_1.vtp.series"}
    # The block of water has 12 by 8 particles, each of which stands for its square; its corners are rounded.
    water = pv.read(meshes / "surface_water_000001.vtp")
    assert water.area == pytest.approx(12 * 8 * 0.025**2, rel=0.08)
    assert water.center[0] == pytest.approx(0.25 + 0.08, abs=0.003)
    sentence = refused(run, "--mode", "surface", "-o", out, "--frame", "0:2", "--save-surface", meshes)
    assert "is there already" in sentence and "surface_water_000000.vtp" in sentence
    listed = json.loads((meshes / "surface_water.vtp.series").read_text())
    assert [entry["time"] for entry in listed["files"]] == [0.0, 0.01]


def test_colours_of_a_surface_are_those_of_a_field_where_asked(run: Path, tmp_path: Path) -> None:
    pictures = []
    for k, words in enumerate(([], ["--color-by", "speed", "--clim", "0,10"])):
        said = rendered(run, "--mode", "surface", *words, "-o", tmp_path / f"{k}.png")
        pictures.append(np.asarray(Image.open(said["pictures"][0])))
    assert (pictures[0] != pictures[1]).any()
    assert "a surface has no bodies" in refused(run, "--mode", "surface", "--color-by", "body")


@pytest.mark.parametrize("mode", ["fluid", "density"])
def test_every_mode_is_drawn_from_the_command_line(run: Path, tmp_path: Path, mode: str) -> None:
    """In 2D here; water and jelly are both there, and move to the right."""
    middles = []
    for k in (0, FRAMES - 1):
        picture = np.asarray(
            Image.open(rendered(run, "--mode", mode, "-o", tmp_path / f"{k}.png", "--frame", k)["pictures"][0])
        )
        inside = picture[40:130, 70:215].astype(int)
        drawn = np.abs(inside - 255).max(axis=2) > 40
        assert drawn.mean() > 0.1
        middles.append(np.nonzero(drawn)[1].mean())
    assert middles[1] > middles[0] + 10


def test_a_liquid_in_space_is_drawn_from_the_command_line(tmp_path: Path) -> None:
    block = lattice((0.1, 0.1, 0.0), (0.4, 0.4, 0.3), 0.025)
    result = write(tmp_path / "run", header((0.5, 0.5, 0.5), 0.05, [WATER]), [frame(0, block), frame(1, block[:0])])
    full, empty = (
        np.asarray(
            Image.open(
                rendered(result.path, "--mode", "fluid", "-o", tmp_path / f"{k}.png", "--frame", k)["pictures"][0]
            )
        )
        for k in (0, 1)
    )
    bluer = full[:, :, 2].astype(int) - full[:, :, 0] > empty[:, :, 2].astype(int) - empty[:, :, 0] + 30
    assert 0.03 < bluer.mean() < 0.6
