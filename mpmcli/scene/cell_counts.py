"""Cells of a domain from its spacing, and its spacing from its cells."""

from mpmcli.scene.quantity import AXES, NUMBER_WORDS, flaw

MOST_CELLS = 2**31 - 1


def cells_of(size: tuple[float, ...], spacing: float) -> tuple[int, ...]:
    """Return the cells per axis; refuse a size (m) that is no whole number of them."""
    ratios = [s / spacing for s in size]
    if max(ratios) > MOST_CELLS:
        raise flaw(f"makes more than {MOST_CELLS} cells along an axis; make it coarser", "spacing")
    # A relative 1e-6 counts as round-off, but never more than a hundredth of a cell.
    broken = [k for k, r in enumerate(ratios) if round(r) < 1 or abs(r - round(r)) > min(1e-6 * r, 1e-2)]
    if not broken:
        return tuple(round(r) for r in ratios)
    said = []
    for k in broken:
        below = int(ratios[k])
        nearest = " or ".join(f"{n * spacing:.8g}" for n in (below, below + 1) if n)
        said.append(f"{size[k]:.8g} m is {ratios[k]:.6g} cells along {AXES[k]}, {nearest} m would fit")
    raise flaw(f"must be a whole number of cells of spacing {spacing:.8g} m: {'; '.join(said)}", "size")


def spacing_of(size: tuple[float, ...], cells: tuple[int, ...]) -> float:
    """Return the spacing, m; refuse cells that are not square or cubic."""
    if len(cells) != len(size):
        raise flaw(f"needs {NUMBER_WORDS[len(size)]} numbers, as domain.size has; found {len(cells)}", "cells")
    spacings = [s / n for s, n in zip(size, cells, strict=True)]
    if max(spacings) - min(spacings) > 1e-6 * max(spacings):
        found = ", ".join(f"{h:.6g} m along {axis}" for axis, h in zip(AXES, spacings, strict=False))
        fitting = ", ".join(str(max(1, round(s / spacings[0]))) for s in size)
        raise flaw(
            f"must make {'square' if len(size) == 2 else 'cubic'} cells; found {found}; "
            f"nearest to the size is [{fitting}]",
            "cells",
        )
    return spacings[0]
