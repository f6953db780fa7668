"""Sums in fixed point: integers, to which atomics add in any order with the same result (docs/theory.md, 8.4)."""

import math

import taichi as ti

# Backends whose devices all add 64-bit integers atomically. Elsewhere a sum is two integers of 32 bits.
WIDE = ("cpu", "cuda")
# Bits of the largest sum: above it there is room for eight times as much, so that it can be seen that one is too large.
BITS_OF_WIDE, BITS_OF_HIGH = 60, 28
# Bits that the lower of two integers adds: 2**17 numbers fit into it, whatever they are.
LOW_BITS = 15
# Largest exponent of a scale, which single precision holds.
LARGEST_EXPONENT = 120


@ti.data_oriented
class FixedSums:
    """Vectors of sums.

    What is added is scaled by a power of two before, so that no sum of absolute values exceeds `largest`, and rounded:
    to integers, or to 2**-low_bits where there are two of them.

    Attributes:
        width: numbers of a vector; wide: whether each is one 64-bit integer.
        low_bits: bits of the lower of two integers.
        largest: the largest sum, as scaled.
    """

    def __init__(self, width: int, count: int, *, wide: bool, low_bits: int = LOW_BITS) -> None:
        """Allocate `count` vectors, all zero."""
        self.width, self.wide, self.low_bits = width, wide, low_bits
        self.largest = 2.0 ** (BITS_OF_WIDE if wide else BITS_OF_HIGH)
        self.high = ti.Vector.field(width, ti.i64 if wide else ti.i32, shape=count)
        self.low = None if wide else ti.Vector.field(width, ti.i32, shape=count)

    def scale(self, bound: float) -> float:
        """Return the power of two that takes `bound`, and no less than its half, to `largest`."""
        exponent = math.floor(math.log2(self.largest / bound)) if bound > 0 else 0
        return 2.0 ** max(-LARGEST_EXPONENT, min(LARGEST_EXPONENT, exponent))

    @ti.func
    def clear(self, place: int):
        """Set a vector to zero."""
        for c in ti.static(range(self.width)):
            self.high[place][c] = 0
            if ti.static(not self.wide):
                self.low[place][c] = 0

    @ti.func
    def add(self, place: int, share: ti.template()):
        """Add scaled numbers, with atomics."""
        for c in ti.static(range(self.width)):
            whole = ti.round(share[c])
            if ti.static(self.wide):
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i64))
            else:
                # The difference is exact.
                rest = ti.round((share[c] - whole) * ti.static(2.0**self.low_bits))
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i32))
                ti.atomic_add(self.low[place][c], ti.cast(rest, ti.i32))

    @ti.func
    def value(self, place: int):
        """Return a vector of scaled sums."""
        result = ti.Vector.zero(float, self.width)
        for c in ti.static(range(self.width)):
            result[c] = ti.cast(self.high[place][c], float)
            if ti.static(not self.wide):
                result[c] += ti.cast(self.low[place][c], float) * ti.static(2.0**-self.low_bits)
        return result
