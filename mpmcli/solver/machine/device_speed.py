"""Kernels that measure what a device can do: copies, launches, and reads and additions at scattered places."""

from collections.abc import Callable
from dataclasses import dataclass

from mpmcli.quick_taichi import ti

# How the places of a table that are read, or added to, follow each other.
RANDOM, SORTED, EQUAL = range(3)
# Neighbours in the list of places that have one place in common where it is sorted, as particles of one cell have.
SHARED = 8
# Iterations of each loop of a kernel whose launch is measured: enough for every thread of a CPU to get a chunk.
FEW = 1024


@dataclass(frozen=True)
class DeviceKernels:
    """Launches of kernels; none waits for the device but `wait`.

    Attributes:
        index: the list of places, a field of i32, which `fill` sets to one of RANDOM, SORTED and EQUAL.
        copy: copies a table of `places` numbers of 4 bytes.
        read, add: reads, or adds to, a number at each place of the list, atomically.
        add_plainly: adds to a number at each place by load and store, on one thread; None on a GPU.
        launches: by number of loops, kernels of that many loops over FEW numbers.
        launch_with_argument: a kernel of one loop that takes a number from the host.
        free: gives the memory back.
    """

    index: ti.Field
    fill: Callable[[int], None]
    copy: Callable[[], None]
    read: Callable[[], None]
    add: Callable[[], None]
    add_plainly: Callable[[], None] | None
    launches: dict[int, Callable[[], None]]
    launch_with_argument: Callable[[float], None]
    wait: Callable[[], None]
    free: Callable[[], None]


def build_device_kernels(places: int, *, on_cpu: bool) -> DeviceKernels:
    """Allocate tables of `places` f32 numbers, a power of two, on the running backend, and return kernels on them."""
    builder = ti.FieldsBuilder()
    table, other, few = ti.field(ti.f32), ti.field(ti.f32), ti.field(ti.f32)
    index = ti.field(ti.i32)
    for field in (table, other, index):
        builder.dense(ti.i, places).place(field)
    builder.dense(ti.i, FEW).place(few)
    tree = builder.finalize()

    @ti.kernel
    def fill(order: ti.i32):
        for i in index:
            place = 0
            if order == RANDOM:
                # A bijection of the numbers below a power of two: xor with a shifted value, and odd factors.
                h = ti.cast(i, ti.u32)
                h = (h ^ (h >> 7)) * ti.u32(0x9E3779B1) & ti.u32(places - 1)
                h = (h ^ (h >> 5)) * ti.u32(0x85EBCA6B) & ti.u32(places - 1)
                place = ti.cast(h ^ (h >> 9), ti.i32)
            elif order == SORTED:
                place = i // SHARED
            index[i] = place

    @ti.kernel
    def copy():
        for i in table:
            other[i] = table[i]

    @ti.kernel
    def read():
        for i in index:
            other[i] = table[index[i]]

    @ti.kernel
    def add():
        for i in index:
            ti.atomic_add(table[index[i]], 1.0)

    @ti.kernel
    def add_plainly():
        ti.loop_config(serialize=True)
        for i in range(places):
            place = index[i]
            table[place] = table[place] + 1.0

    def launch_of(loops: int) -> Callable[[], None]:
        @ti.kernel
        def launch():
            for _ in ti.static(range(loops)):
                for i in few:
                    few[i] = few[i] + 1.0

        return launch

    @ti.kernel
    def launch_with_argument(value: ti.f32):
        for i in few:
            few[i] = few[i] + value

    return DeviceKernels(
        index=index,
        fill=fill,
        copy=copy,
        read=read,
        add=add,
        add_plainly=add_plainly if on_cpu else None,
        launches={loops: launch_of(loops) for loops in range(1, 5)},
        launch_with_argument=launch_with_argument,
        wait=ti.sync,
        free=tree.destroy,
    )
