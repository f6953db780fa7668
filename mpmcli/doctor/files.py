"""Examines the libraries that write files: HDF5 with its filters, and ffmpeg with its encoder."""

import io
import subprocess

from mpmcli.doctor.probe_result import ProbeResult, package_remedy

# Time limit, s. It usually takes 0.1 s.
FFMPEG_TIMEOUT = 20.0


def hdf5() -> ProbeResult:
    """Examine h5py by writing and reading back a file in memory, with the filters of results."""
    import h5py
    import numpy as np

    versions = f"h5py {h5py.version.version}, HDF5 {h5py.version.hdf5_version}"
    values = np.arange(3000, dtype=np.float32).reshape(1000, 3)
    with io.BytesIO() as memory:
        with h5py.File(memory, "w", libver=("v110", "v110")) as file:
            file.create_dataset("values", data=values, chunks=(100, 3), compression="gzip", shuffle=True)
        with h5py.File(memory, "r") as file:
            stored = file["values"]
            filters = [name for name, on in (("gzip", stored.compression == "gzip"), ("shuffle", stored.shuffle)) if on]
            intact = np.array_equal(stored[:], values)
    if not intact or len(filters) < 2:
        return ProbeResult("broken", f"{versions}, gzip and shuffle do not give back what was written")
    return ProbeResult("ok", f"{versions}, filters gzip and shuffle")


def ffmpeg() -> ProbeResult:
    """Examine ffmpeg, which encodes films, by encoding one image."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        return ProbeResult("missing", str(error).partition("\n")[0], package_remedy("imageio-ffmpeg", again=True))
    remedy = "unset IMAGEIO_FFMPEG_EXE if it is set, or " + package_remedy("imageio-ffmpeg", again=True)
    try:
        version = imageio_ffmpeg.get_ffmpeg_version()
    except (OSError, subprocess.CalledProcessError, ValueError) as error:
        reason = f"exited with {error.returncode}" if isinstance(error, subprocess.CalledProcessError) else error
        return ProbeResult("broken", f"{program} is no ffmpeg that runs ({reason})", remedy)
    source = ["-f", "lavfi", "-i", "color=s=16x16", "-frames:v", "1"]
    done = subprocess.run(
        [program, "-v", "error", *source, "-c:v", "libx264", "-f", "null", "-"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=FFMPEG_TIMEOUT,
    )
    if done.returncode:
        first = (done.stderr.strip().splitlines() or [f"exited with {done.returncode}"])[0]
        return ProbeResult("broken", f"{version}, libx264 does not encode ({first}): {program}", remedy)
    return ProbeResult("ok", f"{version}, encoder libx264")
