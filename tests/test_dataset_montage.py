"""A montage of a dataset: which trajectories and frames it shows, what stands above them, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from made_dataset import made_dataset, made_trajectory, write_dataset
from made_sweep import made_workers, make_dataset  # noqa: F401
from PIL import Image

import mpmcli.dataset
from mpmcli.dataset.montage import TrajectoryCells, plan_montage
from mpmcli.errors import InputError
from mpmcli.render.pictures import set_up
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.request import Request
from mpmcli.render.settings import Settings


@pytest.fixture
def dataset(tmp_path) -> Path:
    return made_dataset(tmp_path / "set")


def cells_of(path: Path, numbers: list[int], frame: str | None = None) -> TrajectoryCells:
    return TrajectoryCells(mpmcli.dataset.open(path), numbers, frame)


def test_each_cell_is_a_frame_of_a_trajectory(dataset):
    opened, cells = mpmcli.dataset.open(dataset), cells_of(dataset, [0, 2, 3], "7")
    assert cells.frame_count == 3 and cells.numbers.tolist() == [0, 2, 3]
    for k, number in enumerate((0, 2, 3)):
        frame, whole = cells.frame(k), opened[number]
        np.testing.assert_array_equal(frame.position, whole.position[7])
        np.testing.assert_array_equal(frame.velocity, whole.velocity[7])
        np.testing.assert_array_equal(frame.fields["pressure"], whole.field("pressure")[7])
        np.testing.assert_array_equal(frame.fields["deformation_gradient"], whole.field("deformation_gradient")[7])
        np.testing.assert_array_equal(frame.body, whole.body + 2 * k)
        assert frame.time == whole.times[7] and cells.ledger[k] == whole.ledger[7]


@pytest.mark.parametrize(("frame", "expected"), [(None, 5), ("first", 0), ("last", 10), ("3", 3), ("-2", 9)])
def test_the_frame_is_the_middle_one_or_the_chosen_one(dataset, frame, expected):
    cells = cells_of(dataset, [1], frame)
    np.testing.assert_array_equal(cells.frame(0).position, mpmcli.dataset.open(dataset)[1].position[expected])


def test_the_bodies_of_all_trajectories_share_colours_and_scale(tmp_path):
    """Materials that differ in a number only are one; each body keeps its density and its particles their distance."""
    made = [made_trajectory(0, density=1000.0), made_trajectory(1, density=1500.0)]
    header = {**made[1].header, "spacing": 0.025, "origin": [-0.5, 0.0]}
    path = write_dataset(tmp_path / "set", [made[0], replace(made[1], header=header)])
    scene = render_scene_of(cells_of(path, [0, 1]))
    assert scene.bodies == ("pool", "heap", "pool", "heap")
    assert [one.name for one in scene.appearances] == ["water", "sand"] and scene.material_of == (0, 1, 0, 1)
    assert scene.densities == (1000.0, 1000.0, 1000.0, 1500.0)
    np.testing.assert_allclose(scene.distances, [0.025, 0.025, 0.0125, 0.0125])
    assert scene.lower[:2] == (-0.5, 0.0) and scene.upper[:2] == (1.0, 1.0)


def test_captions_are_numbers_where_nothing_varies(dataset):
    assert cells_of(dataset, [0, 2]).captions == ("0", "2")


@pytest.mark.usefixtures("made_workers")
def test_captions_have_the_values_that_vary_without_those_of_placed_bodies():
    for number, caption in enumerate(cells_of(make_dataset("whole"), [0, 1, 2, 3]).captions):
        assert caption.startswith(f"{number}: friction angle ") and ", gravity.1 -" in caption
        assert "place" not in caption


def test_a_montage_has_no_empty_rows(dataset):
    plan = plan_montage(dataset, Request(montage="3x5"))
    assert plan.setup.settings.grid == (3, 2) and plan.setup.result.numbers.tolist() == [0, 1, 2, 3]
    assert plan.plan[0].path == dataset / "montage.png"
    few = plan_montage(dataset, Request(montage="2x1"))
    assert few.setup.result.numbers.tolist() == [0, 3]


def test_the_montage_is_drawn_again_only_when_it_changed(dataset, drawing):
    (path,) = plan_montage(dataset, Request(montage="2x2")).carry_out().pictures
    before = path.read_bytes()
    assert plan_montage(dataset, Request(montage="2x2")).due == 0
    assert plan_montage(dataset, Request(montage="2x2", frames="2")).due == 4
    path.unlink()
    plan_montage(dataset, Request(montage="2x2")).carry_out()
    assert path.read_bytes() == before
    with Image.open(path) as picture:
        assert picture.size[0] == 1280 and len(picture.getcolors(10**6)) > 10


@pytest.mark.usefixtures("made_workers")
def test_the_commands_draw_a_montage_and_write_the_card(drawing):
    dataset = make_dataset("whole")
    drawn = run_here("render", dataset, "--montage", "2x2", "--color-by", "speed", "-o", "picture.png", "--quiet")
    assert (drawn.status, drawn.stderr) == (0, "") and Path("picture.png").stat().st_size > 1000
    text = (dataset / "README.md").read_text(encoding="utf-8")
    assert run_here("render", dataset, "--montage", "2x2", "--quiet").status == 0
    done = run_here("dataset", "card", dataset)
    assert (done.status, done.stdout, done.stderr) == (0, f"{dataset / 'README.md'}\n", "")
    assert text == (dataset / "README.md").read_text(encoding="utf-8").replace(
        "![Some of the trajectories](montage.png)\n\n", ""
    )


def test_what_is_refused(dataset):
    for request in (Request(), Request(movie=Path("a.mp4")), Request(montage="2x2", save_surface=Path("s"))):
        with pytest.raises(InputError, match="is a dataset, of which --montage 4x4"):
            plan_montage(dataset, request)
    for frame, said in (("all", "no frame of every trajectory"), ("11", "holds frames 0 to 10"), ("-12", "0 to 10")):
        with pytest.raises(InputError, match=said):
            plan_montage(dataset, Request(montage="2x2", frames=frame))
    with pytest.raises(InputError, match='stores no "stress"'):
        plan_montage(dataset, Request(montage="2x2", color="stress"))


def test_each_cell_has_the_colliders_of_its_own_trajectory(tmp_path):
    made = []
    for number, x in enumerate((0.3, 0.7)):
        trajectory = made_trajectory(number)
        post = f'[[colliders]]\nname = "post"\nshape = {{ ball = {{ center = [{x}, 0.8], radius = 0.1 }} }}\n'
        header = {**trajectory.header, "scene": trajectory.header["scene"] + post}
        made.append(replace(trajectory, header=header))
    cells = cells_of(write_dataset(tmp_path / "set", made), [0, 1])
    scene = render_scene_of(cells)
    assert [collider.form.center[0] for collider in scene.colliders] == [0.3, 0.7]
    shown = [[scene.shows(number, cells.frame(k)) for number in range(2)] for k in range(2)]
    assert shown == [[True, False], [False, True]]
    setup = set_up(cells, Settings(mode="dots", color="material", size=(300, 300), camera="front"))
    painter = setup.painter()
    pictures = [painter.draw(cells.frame(k, ())).astype(int) for k in range(2)]
    places = setup.view.pixels(np.array([[0.3, 0.8, 0.0], [0.7, 0.8, 0.0]]))[:, :2].astype(int)
    white = [[bool((picture[row, column] == 255).all()) for column, row in places] for picture in pictures]
    assert white == [[False, True], [True, False]]
