"""Polar decomposition on the device, without singular values or eigenvalues (docs/theory.md, 5.10)."""

import taichi as ti

# Ten iterations reach rounding for all stretches that single precision distinguishes from 0; inverted states need more.
ITERATIONS_MAX = 20


def rounding() -> float:
    """Return the relative rounding error of the running backend's `float`."""
    return 1.2e-7 if ti.lang.impl.current_cfg().default_fp == ti.f32 else 2.3e-16


@ti.func
def polar_rotation(F: ti.template()):
    """Return R of the polar decomposition F = R S: the rotation nearest to F, and so S symmetric.

    R is a rotation for det F < 0 too: the smallest principal stretch is then negative (Irving, Teran and Fedkiw 2004),
    so that the stress drives an inverted particle back. If the nearest rotation is not unique, R is finite but not a
    rotation: F / |F| if two stretches vanish to rounding, 0 at F = 0, and a matrix with |R| < 2 sqrt(3) if
    det F < 0 and the two smallest stretches are equal in size.
    """
    R = ti.Matrix.identity(float, F.n)
    if ti.static(F.n == 2):
        along = F[0, 0] + F[1, 1]
        across = F[1, 0] - F[0, 1]
        length = ti.sqrt(along * along + across * across)
        # For length 0, F is symmetric and traceless, and R = I is one of many equally near rotations.
        if length > 0.0:
            R = ti.Matrix([[along, -across], [across, along]]) / length
    else:
        R = newton_rotation(F)
    return R


@ti.func
def newton_rotation(F: ti.template()):
    """Return the nearest rotation in 3D by Newton's iteration, R <- (a R + b R^-T)/2 with scaling.

    R^-T is the cofactor matrix over det R. The iteration keeps the principal axes for any a and b, so that det R may be
    dropped: a and b scale each term to the norm of a rotation. This is the Frobenius scaling of Higham (1986), without
    a division by a small number. With b = 1/s_1, s_1 the largest stretch, a step takes signed stretches to
    (s_1 + s_2 s_3/s_1, s_2 + s_3, s_2 + s_3), all positive, which treats det F <= 0. Near a rotation
    a = b = 1 converges as fast and costs less.
    """
    X = F
    resolution = ti.static(rounding())
    count = 0
    unsettled = True
    while unsettled and count < ITERATIONS_MAX:
        cofactor = ti.Matrix(
            [
                [
                    X[1, 1] * X[2, 2] - X[1, 2] * X[2, 1],
                    X[1, 2] * X[2, 0] - X[1, 0] * X[2, 2],
                    X[1, 0] * X[2, 1] - X[1, 1] * X[2, 0],
                ],
                [
                    X[2, 1] * X[0, 2] - X[2, 2] * X[0, 1],
                    X[2, 2] * X[0, 0] - X[2, 0] * X[0, 2],
                    X[2, 0] * X[0, 1] - X[2, 1] * X[0, 0],
                ],
                [
                    X[0, 1] * X[1, 2] - X[0, 2] * X[1, 1],
                    X[0, 2] * X[1, 0] - X[0, 0] * X[1, 2],
                    X[0, 0] * X[1, 1] - X[0, 1] * X[1, 0],
                ],
            ]
        )
        determinant = X[0, 0] * cofactor[0, 0] + X[0, 1] * cofactor[0, 1] + X[0, 2] * cofactor[0, 2]
        distance = square_sum(X - cofactor)
        if distance < 0.5 and determinant > 0.5:
            X = 0.5 * (X + cofactor / determinant)
            # A stretch of 1 + e, here |e|^2 <= distance, becomes 1 + e^2/2.
            unsettled = distance > 0.5 * resolution
        else:
            square = square_sum(X)
            cofactor_square = square_sum(cofactor)
            unsettled = cofactor_square > (resolution * square) ** 2
            if unsettled:
                a = ti.sqrt(3.0 / square)
                b = ti.sqrt(3.0 / cofactor_square)
                if determinant <= 0.0:
                    # The sum of the fourth powers of the stretches is close to that of the largest.
                    b = a / ti.sqrt(ti.sqrt(square * square - 2.0 * cofactor_square))
                X = 0.5 * (a * X + b * cofactor)
            else:
                X *= 1.0 / ti.sqrt(ti.max(square, 1e-30))
        count += 1
    return X


@ti.func
def square_sum(A: ti.template()):
    """Return |A|^2 of a 3 x 3 matrix, by rows: a processor overlaps three short sums, not the terms of one."""
    rows = ti.Vector([A[i, 0] * A[i, 0] + A[i, 1] * A[i, 1] + A[i, 2] * A[i, 2] for i in ti.static(range(3))])
    return rows[0] + rows[1] + rows[2]
