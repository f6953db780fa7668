"""A liquid's surface out of the picture of its particles: nearest depth, smoothing, normals, thickness."""

import numpy as np

from mpmcli.render.particle_grid import deposited

# Depth, m, of a pixel that no liquid covers.
NOTHING = np.float32(1e9)
# Rows that are smoothed together: few enough to stay in the cache.
BLOCK = 24
# Standard deviations at which a Gaussian is cut off.
CUT = 2.0
# Pixels of deviation from which a Gaussian is made of boxes.
BOXES_FROM = 8.0
# Taps to one side of a pixel; a wider filter takes wider steps instead.
MOST_TAPS = 16


def sphere_depths(pixels: np.ndarray, scale: np.ndarray, radius: float, shape: tuple[int, int]) -> np.ndarray:
    """Return the distance of the nearest sphere in every pixel, (h, w) float32, m; `NOTHING` where there is none.

    Args:
        pixels: (n, 3) of the centres, pixels from the left and from the top, and the distance, m.
        scale: (n,) pixels to the metre there.
        radius: of the spheres, m. Each is seen as from afar: a disc, whose depth is that of the half sphere.
        shape: rows and columns.
    """
    rows, columns = shape
    reach = radius * scale
    span = int(np.ceil(reach.max())) if len(reach) else 0
    # A sphere whose middle is outside by its radius may reach out as far again.
    border = 2 * span + 1
    width = columns + 2 * border
    buffer = np.full((rows + 2 * border) * width, NOTHING, dtype=np.float32)
    column, row = np.floor(pixels[:, 0]).astype(np.int64), np.floor(pixels[:, 1]).astype(np.int64)
    inside = (column >= -span) & (column < columns + span) & (row >= -span) & (row < rows + span)
    column, row, pixels, reach = column[inside], row[inside], pixels[inside], reach[inside]
    home = (row + border) * width + column + border
    # A sphere smaller than a pixel still shows, in the pixel of its centre.
    flat = (1.0 / np.maximum(reach, 0.75) ** 2).astype(np.float32)
    right, down = (pixels[:, 0] - column).astype(np.float32), (pixels[:, 1] - row).astype(np.float32)
    depth, radius = pixels[:, 2].astype(np.float32), np.float32(radius)
    across = [(np.float32(k + 0.5) - right) ** 2 * flat for k in range(-span, span + 1)]
    for drop in range(-span, span + 1):
        rest = 1 - (np.float32(drop + 0.5) - down) ** 2 * flat
        for shift in range(-span, span + 1):
            if np.hypot(max(abs(drop) - 1, 0), max(abs(shift) - 1, 0)) > span:
                continue
            bulge = rest - across[shift + span]
            hit = np.flatnonzero(bulge > 0)
            np.minimum.at(buffer, home[hit] + (drop * width + shift), depth[hit] - radius * np.sqrt(bulge[hit]))
    return buffer.reshape(-1, width)[border : border + rows, border : border + columns].copy()


def smoothed(depth: np.ndarray, deviation: np.ndarray, radius: float, rounds: int = 2) -> np.ndarray:
    """Return a depth image without the bumps of single particles, and with its edges where they were.

    The narrow-range filter, along the rows and the columns in turn: a Gaussian in which a neighbour counts as it is
    when its depth is within a range of the pixel's own, a range that grows with what it takes in; as lying
    `radius` behind when it is farther back; and not at all, nor its mirror image, when it is in front.

    Source: N. Truong and C. Yuksel, "A narrow-range filter for screen-space fluid rendering", Proc. ACM Comput.
    Graph. Interact. Tech. 1 (2018), 17, section 4.

    Args:
        depth: (h, w) float32, m; `NOTHING` where there is nothing.
        deviation: (h, w) standard deviation of the Gaussian, pixels.
        radius: of a particle, m.
    """
    decay = (0.5 / np.maximum(deviation, 0.3) ** 2).astype(np.float32)
    covered = depth < NOTHING
    widest = float(deviation[covered].max()) if covered.any() else 0.0
    reach = int(np.ceil(CUT * widest))
    stride = max(1, int(np.ceil(reach / MOST_TAPS)))
    steps = [stride] * rounds + ([1] if stride > 1 else [])
    for step in steps:
        taps = min(reach // step, MOST_TAPS)
        depth = _along_rows(depth, decay, radius, taps, step)
        depth = np.ascontiguousarray(
            _along_rows(np.ascontiguousarray(depth.T), np.ascontiguousarray(decay.T), radius, taps, step).T
        )
    return _cleaned(depth, radius) if widest > 1 else depth


def _cleaned(depth: np.ndarray, radius: float) -> np.ndarray:
    """Wipe out the streaks that rows and columns leave: a filter of five by five pixels, in both directions at once."""
    covered = depth < NOTHING
    used_rows, used_columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    if len(used_rows) == 0:
        return depth
    place = slice(used_rows[0], used_rows[-1] + 1), slice(used_columns[0], used_columns[-1] + 1)
    centre, mask = depth[place], covered[place]
    rows, columns = centre.shape
    padded = np.pad(centre, 2, constant_values=NOTHING)
    total, weight = np.zeros_like(centre), np.ones_like(centre)
    for i in range(-2, 3):
        for j in range(-2, 3):
            if i == j == 0:
                continue
            difference = padded[2 + i : 2 + i + rows, 2 + j : 2 + j + columns] - centre
            share = np.float32(np.exp(-(i * i + j * j) / 6)) * (np.abs(difference) < np.float32(2 * radius))
            total += share * np.where(share > 0, difference, 0)
            weight += share
    result = depth.copy()
    result[place] = np.where(mask, centre + total / weight, centre)
    return result


def _along_rows(depth: np.ndarray, decay: np.ndarray, radius: float, taps: int, step: int) -> np.ndarray:
    """Filter along the rows, only where there is something."""
    rows = len(depth)
    reach = taps * step
    result = depth.copy()
    padded = np.pad(depth, ((0, 0), (reach, reach)), constant_values=NOTHING)
    covered = depth < NOTHING
    for top in range(0, rows, BLOCK):
        here = slice(top, min(top + BLOCK, rows))
        used = np.flatnonzero(covered[here].any(axis=0))
        if len(used) == 0:
            continue
        left, right = int(used[0]), int(used[-1]) + 1
        part = padded[here, left : right + 2 * reach]
        moved = _narrow_range(part, decay[here, left:right], np.float32(radius), taps, step)
        mask = covered[here, left:right]
        result[here, left:right][mask] = moved[mask]
    return result


def _narrow_range(part: np.ndarray, decay: np.ndarray, radius: np.float32, taps: int, step: int) -> np.ndarray:
    reach, columns = taps * step, decay.shape[1]
    centre = part[:, reach : reach + columns]
    range_ = 4 * radius
    nearest, farthest = centre - range_, centre + range_
    behind = centre + radius
    total, weight = np.zeros_like(centre), np.ones_like(centre)
    # exp(-k^2 a) by recurrence: the ratio of neighbouring values is exp(-(2 k + 1) a), itself a geometric sequence.
    ratio = np.exp(-decay * np.float32(step * step))
    square = ratio * ratio
    gauss = np.ones_like(centre)
    for tap in range(1, taps + 1):
        gauss *= ratio
        ratio *= square
        shift = tap * step
        before = part[:, reach - shift : reach - shift + columns]
        after = part[:, reach + shift : reach + shift + columns]
        low, high = np.minimum(before, after), np.maximum(before, after)
        fits = low > nearest
        share = gauss * fits
        low_seen, high_seen = low < farthest, high < farthest
        low, high = np.where(low_seen, low, behind), np.where(high_seen, high, behind)
        total += share * ((low - centre) + (high - centre))
        weight += 2 * share
        np.minimum(nearest, low - range_, out=nearest, where=fits)
        np.maximum(farthest, high + range_, out=farthest, where=fits & high_seen)
        np.maximum(farthest, low + range_, out=farthest, where=fits & low_seen)
    return centre + total / weight


def blurred(image: np.ndarray, deviation: float) -> np.ndarray:
    """Return an image (h, w) under a Gaussian, pixels; its sum is kept but for what runs over the edges."""
    if deviation > BOXES_FROM:
        return _boxed(image, deviation)
    reach = int(np.ceil(3 * deviation))
    if reach == 0:
        return image
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights = (weights / weights.sum()).astype(image.dtype)
    for _ in range(2):
        padded = np.pad(image, ((0, 0), (reach, reach)))
        columns = image.shape[1]
        result = weights[reach] * image
        for tap in range(1, reach + 1):
            pair = padded[:, reach - tap : reach - tap + columns] + padded[:, reach + tap : reach + tap + columns]
            result += weights[reach + tap] * pair
        image = np.ascontiguousarray(result.T)
    return image


def _boxed(image: np.ndarray, deviation: float) -> np.ndarray:
    """Return an image under three boxes, which are as good as a wide Gaussian and cost the same at every width.

    A box of w pixels has the variance (w^2 - 1) / 12; the widths are the odd ones whose sum is nearest.
    """
    low = 2 * int((np.sqrt(4 * deviation**2 + 1) - 1) / 2) + 1
    # With m boxes of `low` and the rest two wider: 12 deviation^2 = 3 (low + 2)^2 - 3 - m (4 low + 4).
    count = round((3 * (low + 2) ** 2 - 3 - 12 * deviation**2) / (4 * low + 4))
    result = image.astype(np.float64)
    for _ in range(2):
        for k in range(3):
            half = (low if k < count else low + 2) // 2
            total = np.cumsum(np.pad(result, ((half + 1, half), (0, 0))), axis=0)
            result = (total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1)
        result = np.ascontiguousarray(result.T)
    return result.astype(image.dtype)


def thickness(
    pixels: np.ndarray, volumes: np.ndarray, scale: np.ndarray, deviation: float, shape: tuple[int, int]
) -> np.ndarray:
    """Return (h, w) float32, m: the volume of the particles in every pixel over the area that it sees of them.

    Times the area of a pixel, its sum over a picture in parallel projection is the volume of the particles.

    Args:
        pixels: (n, 2+), from the left and from the top.
        volumes: (n,), m^3.
        scale: (n,) pixels to the metre at the particles.
        deviation: of the Gaussian that each is spread with, pixels.
        shape: rows and columns.
    """
    return blurred(deposited(pixels[:, :2] - 0.5, volumes * scale**2, shape).astype(np.float32), deviation)


def normals(points: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return unit normals (h, w, 3) of a surface, towards the viewer, who looks along minus the third axis.

    In each direction the step to the neighbour is taken whose depth jumps less, so that edges stay sharp.

    Args:
        points: (h, w, 3) of the surface in camera axes: to the right, up and towards the viewer, m.
        covered: (h, w) bool, where there is a surface.
    """
    across, down = (_smaller_step(points, covered, axis) for axis in (1, 0))
    normal = np.empty_like(points)
    # up x right turned round: rows run downwards.
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[..., k] = down[..., i] * across[..., j] - down[..., j] * across[..., i]
    length = np.sqrt(np.einsum("ijk,ijk->ij", normal, normal))
    flat = ~(length > 0)
    normal /= np.where(flat, 1, length)[..., None]
    normal[flat] = (0.0, 0.0, 1.0)
    return normal


def _smaller_step(points: np.ndarray, covered: np.ndarray, axis: int) -> np.ndarray:
    step = np.diff(points, axis=axis)
    pixel = float(np.median(np.abs(step[..., 1 - axis][step[..., 1 - axis] != 0]))) if step.any() else 0.0
    size = np.abs(step[..., 2])
    pair = covered[1:] & covered[:-1] if axis == 0 else covered[:, 1:] & covered[:, :-1]
    size = np.where(pair, size, np.inf)
    step = np.where(pair[..., None], step, 0)
    edge = [(0, 0)] * 3
    ahead, back = edge.copy(), edge.copy()
    ahead[axis], back[axis] = (0, 1), (1, 0)
    forward, backward = np.pad(step, ahead), np.pad(step, back)
    size_forward = np.pad(size, ahead[:2], constant_values=np.inf)
    size_backward = np.pad(size, back[:2], constant_values=np.inf)
    smaller = np.where((size_forward < size_backward)[..., None], forward, backward)
    # Where neither is an edge their mean is one order more exact.
    low, high = np.minimum(size_forward, size_backward), np.maximum(size_forward, size_backward)
    alike = np.isfinite(high) & (high <= 2 * low + np.float32(0.5) * pixel)
    return np.where(alike[..., None], np.float32(0.5) * (forward + backward), smaller)
