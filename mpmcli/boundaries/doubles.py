"""Fields in double precision, as every backend stores them right."""

from mpmcli.quick_taichi import ti


def double_field(*shape: int, width: int | None = None) -> ti.Field:
    """Return a field of float64, of vectors with `width` entries if that is given.

    Taichi 1.7 puts fields of a tree one after another, and on Vulkan it rounds the place of a number of eight bytes
    down to a multiple of eight: behind an odd number of four bytes it would share half of its bytes with another field.
    There the field has a tree of its own; elsewhere it has not, as the number of trees is limited.
    """
    on_vulkan = ti.cfg.arch == ti.vulkan
    within = {} if on_vulkan else {"shape": shape}
    field = ti.field(ti.f64, **within) if width is None else ti.Vector.field(width, ti.f64, **within)
    if on_vulkan:
        builder = ti.FieldsBuilder()
        builder.dense(ti.axes(*range(len(shape))), shape).place(field)
        builder.finalize()
    return field
