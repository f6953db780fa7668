"""Logarithm and exponential from arithmetic alone, which a compiler can vectorise.

A call of the C library prevents vectorisation of a loop over particles. Reduction and coefficients are those of
FreeBSD's msun (Sun Microsystems, 1993), in the two precisions; errors stay below 2 roundings, and devices agree.
"""

import math

from mpmcli.quick_taichi import ti

# By precision, single and double: ln 2 in two parts, the first with trailing zeros; the coefficients of log and exp.
LN2 = (6.9313812256e-01, 9.0580006145e-06), (6.93147180369123816490e-01, 1.90821492927058770002e-10)
LOG = (
    (0.66666662693, 0.40000972152, 0.28498786688, 0.24279078841),
    (
        *(6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01),
        *(1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01),
    ),
)
EXP = (
    (1.6666625440e-1, -2.7667332906e-3),
    (
        *(1.66666666666666019037e-01, -2.77777777770155933842e-03, 6.61375632143793436117e-05),
        *(-1.65339022054652515390e-06, 4.13813679705723846039e-08),
    ),
)
# Bits of the fraction, bias of the exponent, the bits of sqrt(1/2), and the arguments between which exp is normal.
FRACTION, BIAS = (23, 52), (127, 1023)
HALF_ROOT = 0x3F3504F3, 0x3FE6A09E667F3BCD
RANGE = (-87.0, 88.0), (-708.0, 709.0)


def _double() -> int:
    """Return 1 where a `float` of the kernels has double precision, otherwise 0."""
    return int(ti.lang.impl.current_cfg().default_fp == ti.f64)


@ti.func
def _word(x: ti.template()):
    """Return an integer as wide as a `float` of the kernels."""
    if ti.static(_double()):
        return ti.cast(x, ti.i64)
    else:
        return ti.cast(x, ti.i32)


@ti.func
def _bits(x: float):
    """Return the bits of a number."""
    if ti.static(_double()):
        return ti.bit_cast(x, ti.i64)
    else:
        return ti.bit_cast(x, ti.i32)


@ti.func
def _half_root():
    """Return the bits of sqrt(1/2)."""
    if ti.static(_double()):
        return ti.cast(ti.u64(HALF_ROOT[1]), ti.i64)
    else:
        return ti.cast(HALF_ROOT[0], ti.i32)


@ti.func
def _polynomial(coefficients: ti.template(), x: float):
    result = ti.cast(ti.static(coefficients[-1]), float)
    for coefficient in ti.static(coefficients[-2::-1]):
        result = result * x + coefficient
    return result


@ti.func
def log(x: float):
    """Return ln x of a normal number; NaN if x is not above 0."""
    k = ti.static(_double())
    bits = _bits(x)
    exponent = (bits - _half_root()) >> FRACTION[k]
    # x = 2^exponent (1 + f), with 1 + f between sqrt(1/2) and sqrt(2).
    f = ti.bit_cast(bits - (exponent << FRACTION[k]), float) - 1.0
    e = ti.cast(exponent, float)
    s = f / (2.0 + f)
    z = s * s
    R = z * _polynomial(ti.static(LOG[k]), z)
    half = 0.5 * f * f
    result = e * LN2[k][0] - ((half - (s * (half + R) + e * LN2[k][1])) - f)
    return ti.select(x > 0.0, result, ti.static(math.nan))


@ti.func
def _reduced(x: float):
    """Return (2^n, exp(r) - 1) with x = n ln 2 + r; x is clamped to the range of normal exponentials."""
    k = ti.static(_double())
    cut = ti.max(ti.min(x, ti.static(RANGE[k][1])), ti.static(RANGE[k][0]))
    n = ti.floor(cut * ti.static(1 / math.log(2)) + 0.5)
    r = (cut - n * LN2[k][0]) - n * LN2[k][1]
    t = r * r
    c = r - t * _polynomial(ti.static(EXP[k]), t)
    power = (_word(n) + BIAS[k]) << FRACTION[k]
    return ti.bit_cast(power, float), r + r * c / (2.0 - c)


@ti.func
def exp(x: float):
    """Return e^x, clamped to the range of normal numbers."""
    scale, excess = _reduced(x)
    return scale * excess + scale


@ti.func
def exp_minus_1(x: float):
    """Return e^x - 1, also accurate for small x."""
    scale, excess = _reduced(x)
    return scale * excess + (scale - 1.0)
