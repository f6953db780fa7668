"""Computes a scene and its siblings, keeps what each has shown, and forms the bars."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from mpmcli.check.geometry import thin_colliders
from mpmcli.check.shape_rules import STANDOFF
from mpmcli.error_bars.bars import Bars, bars_of
from mpmcli.error_bars.observables import Map, Observer, Series
from mpmcli.error_bars.siblings import (
    CAUSES,
    LEVELS,
    SAMPLING,
    SOFTER,
    Cause,
    LeftOut,
    Level,
    Reach,
    Sibling,
    siblings_of,
    tables_of,
)
from mpmcli.errors import InputError, MpmcliError, RunError
from mpmcli.materials.registry import laws as known_laws
from mpmcli.materials.registry import parameter_models
from mpmcli.output.durable import sealed, writing
from mpmcli.output.result import Result
from mpmcli.scene import LoadedScene, Scene, parse_scene, sample_bodies
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.expression import Expression
from mpmcli.scene.problem import several
from mpmcli.simulation.engine import backend_for
from mpmcli.simulation.runner import Runner
from mpmcli.solver.machine.backend import Arch
from mpmcli.validation.runs import program

# Verdicts of a run that shows nothing.
BROKEN = ("unstable", "escaped")
BASE = "the scene"
# Half the step is no sibling where frames set the step: steps that its run has more at least, as a factor.
MORE_STEPS = 1.3
# Thickness of a body on the coarsest grid below which the report says so, cells.
THIN = 4.0


@dataclass
class Study:
    """A scene, its series, the siblings that were computed, and those that were left out with the reason."""

    scene: Scene
    base: Series
    runs: list[tuple[Sibling, Series]] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    confidence: int = 90

    @cached_property
    def bars(self) -> Bars:
        """The bars of all that was computed."""
        return bars_of(self.base, self.runs, self.confidence, self.warnings())

    @property
    def cost(self) -> float:
        """Seconds of the siblings over those of the scene."""
        return sum(series.seconds for _, series in self.runs) / max(self.base.seconds, 1e-9)

    def warnings(self) -> list[str]:
        """Return sentences on errors that the bars do not contain."""
        found = []
        table = ContactTable(self.scene)
        shared = [source for source in self.scene.sources if not table.separates(source)]
        if len(shared) > 1 and any(source.has_surface for source in shared):
            found.append('Bodies stick: the bar does not contain that; contact.default = "separate" parts them.')
        plates = thin_colliders(self.scene, self.scene.domain.spacing)
        if plates and not all(source.has_surface for source in self.scene.sources):
            off = "liquids and grains stand {:g} to {:g} cells off; the bar may not contain that".format(*STANDOFF)
            found.append(f"{several(plates)}: thinner than a cell, from which {off}.")
        coarsest = self.scene.domain.spacing * max((one.ratio for one, _ in self.runs), default=1.0)
        boxes = {body.name: np.ptp(np.array(body.shape.form.bounds()), axis=0) for body in self.scene.bodies}
        if thin := [name for name, size in boxes.items() if size.min() < THIN * coarsest]:
            what = f"{several(thin)}: fewer than {THIN:g} cells thick on the coarsest grid"
            found.append(f"{what}; bars may be too narrow.")
        if not any(sibling.cause == "grid" for sibling, _ in self.runs):
            found.append("No coarser grid was computed: the bar does not contain the error of the spacing.")
        return found


@dataclass
class StudyPlan:
    """What to compute: causes, confidence in percent, observed expressions, and where.

    `directory` keeps the series of each run, so that they are not computed twice; None keeps none.
    """

    causes: tuple[Cause, ...] = LEVELS["grids"]
    confidence: int = 90
    observed: Mapping[str, Expression] = field(default_factory=dict)
    directory: Path | None = None
    arch: Arch = "auto"
    threads: int | None = None

    def cost(self, dimension: int) -> float:
        """Return the forecast of the time of the siblings in runs of the scene."""
        costs = {"grid": sum(r ** -(dimension + 1) for r in (2**0.5, 2.0)), "rounding": 1.0, "step": 2.0}
        costs["model"] = (1 + SOFTER**0.5) * 2.0 ** -(dimension + 1)
        costs |= {"placement": 2.0, "sample": 1 + 1.5**dimension}
        return sum(costs[cause] for cause in self.causes)


def chosen_causes(level: Level, only: Sequence[str] = (), skip: Sequence[str] = ()) -> tuple[Cause, ...]:
    """Return the causes of a level, or those named, without others; InputError: none is left."""
    causes = tuple(cause for cause in (only or LEVELS[level]) if cause not in skip)
    if not {*causes} - {"model"}:
        why = ", as model needs grid" if causes else ""
        raise InputError(f"--only and --skip leave nothing to compute{why}: give other causes, or another --level.")
    return tuple(cause for cause in CAUSES if cause in causes)


class Student:
    """Computes the runs of one study in this process, with kernels that are shared."""

    def __init__(self, loaded: LoadedScene, plan: StudyPlan, chosen: Sequence[Sequence[str]] | None = None) -> None:
        """`chosen`: the automatic parameters of each body and emitter; by default those that the scene leaves out."""
        self.plan, self.scene = plan, loaded.scene
        materials = [source.material for source in loaded.scene.sources]
        chosen = chosen or [[*({*type(one).model_fields} - one.model_fields_set)] for one in materials]
        self.choices = {
            source.name: (*(n for n in names if n.endswith("_modulus")), *([] if source.has_surface else [SAMPLING]))
            for source, names in zip(loaded.scene.sources, chosen, strict=True)
        }
        self._folder = Path(loaded.source).parent
        self.tables = tables_of(loaded.scene)
        self.map = Map.of(loaded.scene)
        backend = backend_for(loaded.scene, plan.arch, plan.threads)
        self._runner = Runner(backend.arch, backend.threads, backend.optimisation, alike=True)

    def base_of(self, result: Result, seconds: float, steps: int) -> Series:
        """Return the series of a finished result of the scene, which took some seconds and steps."""
        kept = _Kept(self, BASE, self.tables)
        if (found := kept.read()) is None:
            observer = Observer(self.scene, sample_bodies(self.scene), self.map, self.plan.observed)
            for k, row in enumerate(result.ledger):
                observer.take(result.present_frame(k, ()), row)
            found = observer.series()
            kept.keep(found)
        facts = {"seconds": seconds, "steps": steps, "particles": int(result.particle_counts[-1])}
        return replace(found, **facts)

    def base(self, stop: Callable[[], bool]) -> Series:
        """Compute the scene. Raises RunError with the reason if it is unstable."""
        self._runner.expect([self.scene])
        return self.compute(BASE, self.tables, stop)

    def study(
        self, base: Series, tell: Callable[[str, int, int], None], stop: Callable[[], bool] = lambda: False
    ) -> Study:
        """Compute the siblings; `tell` is given the name of each, its number, and how many there are.

        Raises:
            RunError: there is no sibling, with the reasons.
            KeyboardInterrupt: `stop` returned True; the runs that are done are kept.
        """
        study = Study(self.scene, base, confidence=self.plan.confidence)
        wanted: list[tuple[Sibling, Scene]] = []
        for one in siblings_of(self.tables, base.reach, self.plan.causes, self.choices):
            try:
                wanted += [(one, self._scene_of(one.tables))] if isinstance(one, Sibling) else []
                study.left_out += [one] if isinstance(one, LeftOut) else []
            except MpmcliError as error:
                study.left_out.append(LeftOut(one.name, one.cause, _first_line(error)))
        missing = [scene for one, scene in wanted if _Kept(self, one.name, one.tables).read() is None]
        if missing:
            self._runner.expect([self.scene, *missing])
        for k, (sibling, _) in enumerate(wanted):
            tell(sibling.name, k, len(wanted))
            try:
                series = self.compute(sibling.name, sibling.tables, stop)
            except MpmcliError as error:
                study.left_out.append(LeftOut(sibling.name, sibling.cause, _first_line(error)))
                continue
            if sibling.cause == "step" and series.steps < MORE_STEPS * base.steps:
                reason = "the intervals of the frames set the step, and half of it is hardly smaller"
                study.left_out.append(LeftOut(sibling.name, sibling.cause, reason))
                continue
            study.runs.append((sibling, series))
        if not study.runs:
            why = "; ".join(f"{one.name}: {one.reason}" for one in study.left_out)
            raise RunError(f"There are no error bars, because no sibling was computed: {why}.")
        return study

    def _scene_of(self, tables: Mapping[str, Any]) -> Scene:
        return parse_scene(dict(tables), laws=parameter_models(), directory=self._folder).scene

    def compute(self, name: str, tables: Mapping[str, Any], stop: Callable[[], bool]) -> Series:
        """Return the series of a run, computed or kept; RunError: it is unstable."""
        kept = _Kept(self, name, tables)
        if (found := kept.read()) is not None:
            return found
        scene = self._scene_of(tables)
        particles = sample_bodies(scene)
        observer = Observer(scene, particles, self.map, self.plan.observed)
        recording = self._runner.run(scene, stop, observer.take, particles)
        if recording.verdict in BROKEN:
            raise RunError(f"The run of {name} is {recording.verdict}: {recording.reason}")
        facts = {name: getattr(recording, name) for name in ("seconds", "steps", "particles")}
        series = replace(observer.series(), **facts)
        kept.keep(series)
        return series


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0].rstrip(".")


class _Kept:
    """The file of one series; it is found again for the same tables, map, observables and program."""

    ARRAYS = ("time", "maps")
    FACTS = ("mass", "seconds", "steps", "particles")

    def __init__(self, student: Student, name: str, tables: Mapping[str, Any]) -> None:
        plan = student.plan
        observed = {name: expression.text for name, expression in plan.observed.items()}
        known = [tables, observed, sorted(known_laws()), student.map.edge, *program()]
        key = hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:16]
        self._path = plan.directory and plan.directory / f"{key}.npz"

    def read(self) -> Series | None:
        """Return the series, None if there is none."""
        if self._path is None or not self._path.exists():
            return None
        try:
            with np.load(self._path, allow_pickle=False) as stored:
                names = json.loads(str(stored["names"]))
                reach = Reach(*stored["reach"])
                facts = json.loads(str(stored["facts"]))
                values = dict(zip(names, stored["values"], strict=True))
                return Series(stored["time"], values, stored["maps"], reach, **facts)
        except (OSError, ValueError, KeyError, BadZipFile):
            return None

    def keep(self, series: Series) -> None:
        """Write the series, if there is a directory. Raises RunError on failure."""
        if self._path is None:
            return
        names, rows = list(series.values), np.array(list(series.values.values()))
        reach = np.array([series.reach.low, series.reach.high, series.reach.middle])
        facts = {name: getattr(series, name) for name in self.FACTS}
        with writing(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with sealed(self._path, unique=True) as temporary, temporary.open("wb") as file:
                np.savez_compressed(
                    file,
                    **{name: getattr(series, name) for name in self.ARRAYS},
                    values=rows,
                    reach=reach,
                    names=json.dumps(names),
                    facts=json.dumps(facts),
                )
