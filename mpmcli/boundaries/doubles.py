"""Fields and numbers in double precision that are correct on every backend."""

from taichi.lang.expr import Expr
from taichi.lang.impl import inside_kernel

from mpmcli.quick_taichi import ti

# pi / 2 in two parts, of which the first has 33 bits (fdlibm, e_rem_pio2.c); terms of the series.
QUARTER, REST, TERMS = 1.57079632673412561417, 6.07710050650619224932e-11, 10


def double_field(*shape: int, entries: tuple[int, ...] = ()) -> ti.Field:
    """Return a field of float64 numbers, or of vectors or matrices with the shape `entries`.

    Taichi 1.7 stores the fields of an SNode tree one after another, and on Vulkan it rounds the offset of 8-byte
    numbers down to a multiple of eight: after an odd number of 4-byte numbers a field would share half of its first
    number with another field. On Vulkan the field therefore has its own tree. On other backends it does not, because
    the number of trees is limited.
    """
    on_vulkan = ti.lang.impl.current_cfg().arch == ti.vulkan
    within = {} if on_vulkan else {"shape": shape}
    kind = {0: ti.field, 1: ti.Vector.field, 2: ti.Matrix.field}[len(entries)]
    field = kind(*entries, ti.f64, **within)
    if on_vulkan:
        builder = ti.FieldsBuilder()
        builder.dense(ti.axes(*range(len(shape))), shape).place(field)
        builder.finalize()
    return field


def _double(number: object) -> object:
    if not inside_kernel():
        return float(number)
    return ti.cast(number, ti.f64) if isinstance(number, Expr) else Expr(float(number), dtype=ti.f64)


@ti.pyfunc
def as_double(number: ti.template()):
    """Return a number in double precision: a literal in a kernel has the precision of particles."""
    (double,) = ti.static((_double(number),))
    return double


@ti.func
def sin_cos(x: ti.f64):
    """Return sine and cosine of an angle up to 1e6, to round-off: those of Taichi are in f32 on Vulkan."""
    turns = ti.floor(x / as_double(QUARTER) + 0.5)
    r = x - turns * as_double(QUARTER) - turns * as_double(REST)
    s, c = as_double(1.0), as_double(1.0)
    for k in ti.static(range(TERMS, 0, -1)):
        s = 1.0 - r * r / (2 * k * (2 * k + 1)) * s
        c = 1.0 - r * r / ((2 * k - 1) * 2 * k) * c
    s *= r
    quarter = ti.cast(turns, int) & 3
    if quarter % 2 == 1:
        s, c = c, s
    if quarter >= 2:
        s = -s
    if quarter == 1 or quarter == 2:
        c = -c
    return s, c
