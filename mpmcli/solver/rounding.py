"""Keeps compilers from simplifying sums whose rounding is what is asked for."""

import taichi as ti


@ti.func
def opaque(x: float):
    """Return a number of single precision that is not negative, as no compiler can tell.

    Those of Vulkan and Metal reorder sums, and would find that a rounded sum less its first term is the second.
    """
    return ti.bit_cast(ti.max(ti.bit_cast(x, ti.i32), 0), ti.f32)


@ti.func
def opaque_signed(x: float):
    """Return a number of single precision of any sign, as `opaque` does."""
    size = opaque(ti.abs(x))
    return ti.select(x < 0.0, -size, size)
