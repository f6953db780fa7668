"""Tests of films: what another reader finds in them, the same bytes for the same pictures, and what cannot be made."""

from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import psutil
import pytest
from PIL import Image

from mpmcli.errors import InputError, RunError
from mpmcli.render.picture_file import write_film, write_picture

COUNT = 12
HEIGHT, WIDTH = 48, 65  # odd on purpose
BLUE, WHITE, RED = (30, 60, 200), (240, 240, 240), (200, 40, 30)


def picture(k: int) -> np.ndarray:
    """Return a white picture with a blue square that moves 4 pixels a frame, and a red edge on the right."""
    image = np.full((HEIGHT, WIDTH, 3), WHITE, np.uint8)
    image[16:32, 4 * k : 4 * k + 12] = BLUE
    image[:, -5:] = RED
    return image


def saved(folder: Path, images: Sequence[np.ndarray]) -> list[Path]:
    paths = [folder / f"{k}.png" for k in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        write_picture(path, image, "digest")
    return paths


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return saved(tmp_path_factory.mktemp("pictures"), [picture(k) for k in range(COUNT)])


def read_mp4(path: Path) -> tuple[dict, list[np.ndarray]]:
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    return facts, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def read_gif(path: Path) -> tuple[list[float], list[np.ndarray]]:
    """Return the durations, ms, and the frames."""
    with Image.open(path) as film:
        durations, images = [], []
        for k in range(film.n_frames):
            film.seek(k)
            images.append(np.asarray(film.convert("RGB")))
            durations.append(film.info["duration"])
    return durations, images


def check_colours(images: list[np.ndarray], tolerance: float) -> None:
    """Compare the middle of the square, of the edge and of the ground, away from where colours blend."""
    assert len(images) == COUNT
    for k, image in enumerate(images):
        for place, colour in (((24, 4 * k + 6), BLUE), ((4, 30), WHITE), ((24, WIDTH - 2), RED)):
            assert np.abs(image[place].astype(int) - colour).max() <= tolerance, (k, place)


def test_an_mp4_is_h264_with_every_frame_in_its_time_and_colour(pictures, tmp_path):
    path, seen = tmp_path / "new" / "film.mp4", []
    write_film(pictures, path, 24, watch=seen.append)
    facts, images = read_mp4(path)
    assert facts["codec"] == "h264" and facts["pix_fmt"].startswith("yuv420p(tv, bt709")
    # One column more than the pictures, like their last.
    assert facts["size"] == (WIDTH + 1, HEIGHT) and facts["fps"] == 24
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (COUNT, pytest.approx(COUNT / 24, abs=0.01))
    # Luma has 219 levels; 18 of the encoder's scale leaves a few more of error.
    check_colours(images, 8)
    assert np.abs(images[3][:, -1].astype(int) - RED).max() <= 8
    assert seen == list(range(1, COUNT + 1))
    # Players can begin before the end has come: the index precedes the pictures.
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")
    assert [entry.name for entry in path.parent.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("fps", [10, 30, 50])
def test_a_gif_has_every_frame_in_its_colour_and_keeps_time(pictures, tmp_path, fps):
    path = tmp_path / "film.gif"
    write_film(pictures, path, fps)
    durations, images = read_gif(path)
    # Pillow's search for the nearest colour goes in steps of 4 levels.
    check_colours(images, 4)
    for k in range(COUNT + 1):
        assert abs(sum(durations[:k]) - 1000 * k / fps) <= 5
    with Image.open(path) as film:
        assert film.info["loop"] == 0 and film.size == (WIDTH, HEIGHT)


def test_the_colours_of_a_gif_come_from_the_whole_film(tmp_path):
    """Each picture has another of 100 colours: those of the first alone would not do for the others."""
    rows = np.linspace(0, 255, 100)
    images = [np.full((20, 20, 3), (level, 255 - level, 128), np.uint8) for level in rows]
    write_film(saved(tmp_path, images), tmp_path / "film.gif", 20)
    _, found = read_gif(tmp_path / "film.gif")
    error = [np.abs(image.astype(int) - shown).max() for image, shown in zip(images, found, strict=True)]
    # Twelve pictures are asked: the levels lie 255 / 11 apart.
    assert max(error) <= 255 / 22 + 4


def test_a_picture_like_the_one_before_it_is_a_frame_too(tmp_path):
    write_film(saved(tmp_path, [picture(0), picture(0), picture(1)]), tmp_path / "film.gif", 25)
    durations, images = read_gif(tmp_path / "film.gif")
    assert durations == [40, 40, 40] and len(images) == 3
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[1], images[2])


@pytest.mark.parametrize("end", ["mp4", "gif"])
def test_the_same_pictures_give_the_same_bytes(pictures, tmp_path, end):
    write_film(pictures, tmp_path / f"a.{end}", 24)
    write_film(saved(tmp_path, [picture(k) for k in range(COUNT)]), tmp_path / f"b.{end}", 24)
    assert (tmp_path / f"a.{end}").read_bytes() == (tmp_path / f"b.{end}").read_bytes()


@pytest.mark.parametrize(
    ("name", "fps", "sentence"),
    [
        ("film.avi", 24, r"film.avi cannot be a film: give a name that ends in .mp4 or .gif"),
        ("film.mp4", 0, r"0 frames per second are not possible"),
        ("film.mp4", float("nan"), r"nan frames per second are not possible"),
        ("film.gif", 60, r"film.gif cannot show 60 frames per second, as a gif has 50 at most"),
    ],
)
def test_what_is_no_film_is_bad_input(pictures, tmp_path, name, fps, sentence):
    with pytest.raises(InputError, match=sentence):
        write_film(pictures, tmp_path / name, fps)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("end", ["mp4", "gif"])
def test_pictures_that_make_no_film_leave_nothing(pictures, tmp_path, end):
    path = tmp_path / f"film.{end}"
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(pictures[0].read_bytes()[:80])
    low = tmp_path / "low.png"
    write_picture(low, picture(1)[1:], "digest")
    cases = [
        ([], "at least one picture"),
        ([pictures[0], low], "low.png is 65x47 and those before it 65x48"),
        ([pictures[0], damaged], "damaged.png cannot be read as a picture"),
        ([pictures[0], tmp_path / "none.png"], "none.png cannot be read as a picture"),
    ]
    for given, sentence in cases:
        with pytest.raises(InputError, match=sentence):
            write_film(given, path, 24)
        assert sorted(entry.name for entry in tmp_path.iterdir()) == ["damaged.png", "low.png"]


@pytest.mark.parametrize("end", ["mp4", "gif"])
def test_an_interrupt_leaves_neither_a_file_nor_a_process(pictures, tmp_path, end):
    def interrupt(done: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    # Python's own helper of multiprocessing may be there, from another test.
    before = psutil.Process().children(recursive=True)
    with pytest.raises(KeyboardInterrupt):
        write_film(pictures, tmp_path / f"film.{end}", 24, watch=interrupt)
    assert list(tmp_path.iterdir()) == [] and psutil.Process().children(recursive=True) == before


def test_without_ffmpeg_one_sentence_says_so(pictures, tmp_path, monkeypatch):
    def none() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none)
    with pytest.raises(InputError, match=r"There is no ffmpeg for films: install imageio-ffmpeg or ffmpeg"):
        write_film(pictures, tmp_path / "film.mp4", 24)


@pytest.mark.parametrize(("script", "sentence"), [
    ("echo 'the encoder is not there' >&2; exit 3", "film.mp4, its status is 3: the encoder is not there"),
    ("cat > /dev/null; exit 1", "film.mp4, its status is 1: it gave no reason"),
    ("kill -9 $$", "film.mp4, it was ended by signal 9: it gave no reason"),
    # SIGXFSZ, and the exit status that ffmpeg has after ENOSPC.
    ("kill -25 $$", r"film.mp4 could not be written \(File too large\)"),
    ("exit 228", r"film.mp4 could not be written \(No space left on device\)"),
])  # fmt: skip
def test_an_ffmpeg_that_fails_ends_the_film_and_keeps_the_old_one(pictures, tmp_path, monkeypatch, script, sentence):
    program, path = tmp_path / "ffmpeg", tmp_path / "film.mp4"
    program.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    program.chmod(0o755)
    path.write_bytes(b"the film before")
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(program))
    with pytest.raises(RunError, match=sentence):
        write_film(pictures, path, 24)
    assert path.read_bytes() == b"the film before" and len(list(tmp_path.iterdir())) == 2
