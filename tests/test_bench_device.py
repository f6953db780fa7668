"""What is measured of a device: lists of places are right, and every figure is there. No clock decides."""

import json

import numpy as np
import pytest

from mpmcli.bench import device
from mpmcli.bench.device import best_seconds

PLACES = 1 << 18


class TestBestSeconds:
    def test_the_first_call_does_not_count_and_the_best_series_does(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Calls take 9 s, then 2 s each in the first series and 1 s each in the others."""
        now, calls = [0.0], []

        def run() -> None:
            calls.append(now[0])
            now[0] += 9.0 if len(calls) == 1 else 2.0 if len(calls) < 4 else 1.0

        monkeypatch.setattr(device.time, "perf_counter", lambda: now[0])
        assert best_seconds(run, lambda: None, seconds=3.5) == 1.0

    def test_waits_count(self, monkeypatch: pytest.MonkeyPatch) -> None:
        now = [0.0]

        def wait() -> None:
            now[0] += 8.0

        monkeypatch.setattr(device.time, "perf_counter", lambda: now[0])
        assert best_seconds(lambda: None, wait, seconds=1.0, at_once=4) == 2.0


class TestKernels:
    def test_places(self, backend_of) -> None:
        from mpmcli.solver.machine.device_speed import EQUAL, RANDOM, SHARED, SORTED, build_device_kernels

        backend_of("f32")
        kernels = build_device_kernels(PLACES, on_cpu=True)
        kernels.fill(RANDOM)
        found = kernels.index.to_numpy()
        np.testing.assert_array_equal(np.sort(found), np.arange(PLACES))
        # A line of the cache holds 16 numbers: of a random permutation 32 neighbours in PLACES are as close.
        assert (np.abs(np.diff(found)) < 16).mean() < 100 * 32 / PLACES
        kernels.fill(SORTED)
        np.testing.assert_array_equal(kernels.index.to_numpy(), np.arange(PLACES) // SHARED)
        kernels.fill(EQUAL)
        assert not kernels.index.to_numpy().any()
        kernels.free()


@pytest.mark.parametrize("arch", ["cpu", pytest.param("vulkan", marks=pytest.mark.gpu)])
def test_every_figure_is_there_as_json(arch: str, run_python) -> None:
    done = run_python(f"""
import json
from mpmcli.bench.device import measure_device
from mpmcli.solver.machine.backend import start_backend
print(json.dumps(measure_device(start_backend("{arch}"), 0.0, large=4096, small=1024)))
""")
    found = json.loads(done.stdout)
    assert found["arch"] == arch
    assert set(found["launch_us"]) == {"1", "2", "3", "4"}
    assert {name: table["bytes"] for name, table in found["tables"].items()} == {"large": 16384, "small": 4096}
    rates = {name for table in found["tables"].values() for name in table} - {"bytes"}
    plain = {"plain_add_random_g_per_s", "plain_add_sorted_g_per_s", "plain_add_same_g_per_s"}
    assert rates == {
        "copy_gb_per_s",
        "read_random_g_per_s",
        "read_sorted_g_per_s",
        "atomic_add_random_g_per_s",
        "atomic_add_sorted_g_per_s",
        "atomic_add_same_g_per_s",
        *(plain if arch == "cpu" else ()),
    }
    assert all(table[name] > 0 for table in found["tables"].values() for name in table)
    assert ("memcpy_gb_per_s" in found) == (arch == "cpu")
