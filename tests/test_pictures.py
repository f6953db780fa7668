"""The pictures of the example scenes and the film of the README: small, complete, and made by the scripts."""

import importlib.machinery
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command import ROOT, run_here
from PIL import Image

from mpmcli.render.picture_file import digest_of

PICTURES = ROOT / "docs" / "pictures"
BYTES_MAX, FILM_MAX, PLOT_MAX = 4e6, 1.5e6, 6e4
# Drawn by scripts/peers with Matplotlib.
PLOT = PICTURES / "peers.png"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, which needs its neighbours, and leaves no compiled files among them."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = importlib.machinery.SourceFileLoader("picture_table", str(ROOT / "scripts" / "picture_table"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("picture_table", loader))
    loader.exec_module(module)
    return module


def test_every_scene_has_a_picture() -> None:
    """On the page of the gallery, as test_docs.py says; others are on two pages."""
    names = sorted(path.stem for path in (ROOT / "configs").glob("*.toml"))
    pages = "".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("tutorial.md", "pictures.md"))
    others = re.findall(r"\(pictures/(\w+)\.png\)", pages)
    assert sorted(path.stem for path in PICTURES.glob("*.png") if path != PLOT) == sorted([*names, *others])


def test_pictures_are_small_and_of_mpmcli() -> None:
    assert sum(path.stat().st_size for path in PICTURES.iterdir()) < BYTES_MAX
    for path in set(PICTURES.glob("*.png")) - {PLOT}:
        assert digest_of(path), path.name
        with Image.open(path) as picture:
            # Not blank, and nothing but what a page can hold.
            assert picture.width == 760 and len(picture.convert("RGB").getcolors(2**24)) > 20


def test_the_plot_is_small_and_fits_the_page() -> None:
    with Image.open(PLOT) as picture:
        assert picture.width == 900 and PLOT.stat().st_size < PLOT_MAX


def test_the_film_is_small_and_moves() -> None:
    film = PICTURES / "film.webp"
    assert film.stat().st_size < FILM_MAX
    with Image.open(film) as frames:
        first = np.asarray(frames.convert("RGB"), int)
        frames.seek(frames.n_frames - 1)
        assert frames.n_frames >= 30 and np.abs(np.asarray(frames.convert("RGB"), int) - first).mean() > 1


def test_a_smaller_file_has_the_same_pixels(script: ModuleType, tmp_path: Path) -> None:
    from mpmcli.render.picture_file import write_picture

    gradient = np.add.outer(np.arange(200), np.arange(300))[:, :, None] // np.array([2, 3, 4])
    image = gradient.astype(np.uint8)
    write_picture(tmp_path / "a.png", image, "some digest")
    before = (tmp_path / "a.png").stat().st_size
    script.compress(tmp_path / "a.png")
    assert digest_of(tmp_path / "a.png") == "some digest"
    with Image.open(tmp_path / "a.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), image)
    assert (tmp_path / "a.png").stat().st_size <= before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elliptical_drop_2d", "stirred_tank_2d"])
def test_the_committed_picture_is_what_the_scene_gives(script: ModuleType, tmp_path: Path, name: str) -> None:
    """Run and drawn again; another machine may round some pixels of an edge otherwise."""
    grid, options = script.MONTAGES[name]
    assert run_here("simulate", ROOT / "configs" / f"{name}.toml", "-o", tmp_path / "run", "--quiet").status == 0
    words = ["--montage", grid, *options.split(), "--size", f"{script.WIDTH}xauto", "-o", tmp_path / "again.png"]
    done = run_here("render", tmp_path / "run", *words)
    assert done.status == 0, done.stderr
    again, committed = (np.asarray(Image.open(path)) for path in (tmp_path / "again.png", PICTURES / f"{name}.png"))
    assert again.shape == committed.shape
    differs = np.abs(again.astype(int) - committed).max(axis=2) > 8
    assert differs.mean() < 0.01
