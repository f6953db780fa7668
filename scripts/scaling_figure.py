"""The figure of `mpmcli bench --scaling`: time per particle and step against the number of particles."""

from mpmcli.validation.figures import drawing, logarithmic_x, logarithmic_y, saved

# Colour and marker of each contestant, of the colours of Okabe and Ito (2008), and their order in the legend.
STYLES = {"mpmcli": ("#000000", "o"), "C": ("#0072b2", "s"), "mpm88": ("#d55e00", "^"), "mpm3d": ("#d55e00", "^")}
SIZE = (10.0, 4.2)


def draw_scaling(report: dict) -> bytes:
    """Return the figure as SVG: a panel per dimension, a line per contestant and number of threads.

    Args:
        report: what `mpmcli bench --scaling --json` printed.
    """
    found = report["scaling"]
    dimensions = sorted({row["dimension"] for row in found})
    with drawing(SIZE) as figure:
        panels = figure.subplots(1, len(dimensions), sharey=True, squeeze=False)[0]
        for axes, dimension in zip(panels, dimensions, strict=True):
            own = [row for row in found if row["dimension"] == dimension]
            axes.set_title(f"{dimension}D fluid")
            axes.set_xlabel("particles")
            logarithmic_x(axes, [row["particles"] for row in own])
            for label, threads in dict.fromkeys((row["label"], row["threads"]) for row in own):
                line = sorted(
                    (row["particles"], row["ns_per_particle_step"])
                    for row in own
                    if (row["label"], row["threads"]) == (label, threads)
                )
                color, marker = STYLES[label]
                axes.plot(
                    *zip(*line, strict=True),
                    color=color,
                    marker=marker,
                    markersize=5,
                    linewidth=1.4,
                    linestyle="-" if threads == 1 else "--",
                    label=f"{label}, {threads} thread{'s' * (threads > 1)}",
                )
            axes.legend(loc="best", fontsize=8.5)
        logarithmic_y(panels[0], [row["ns_per_particle_step"] for row in found])
        panels[0].set_ylabel("ns per particle and step")
        return saved(figure)
