"""Sensor noise on the agent view: five image corruptions, sampled again for every frame."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, ClassVar, Literal, TypeVar, get_args

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from pipeline import seeding
from pipeline.axes.base import LEVELS, Axis, ByLevel, PixelPerturbation, level_from, pick
from pipeline.axes.component_names import current_names, stored_names
from pipeline.axes.corruptions import Component, Fog, Gaussian, Glass, Motion, Zoom
from pipeline.axes.report_data import BENCHMARK, CoveragePlots, KeptPerturbation, ObservedEpisode, Strips
from pipeline.episode_schema import SIZE_PX
from pipeline.errors import PipelineError
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.testset.definitions import Value
from pipeline.types import Floats, Frame, Task

Effect = Motion | Gaussian | Zoom | Fog | Glass
"""Corruptions. ``strength`` is the name of the parameter that grows with the severity, and its value in a clean frame.
"""
E = TypeVar("E", Motion, Gaussian, Zoom, Fog, Glass)


class NoisePerturbation(PixelPerturbation):
    """One corruption at one strength for a whole episode.

    Attributes:
        component: name of the effect; the blur by a Gaussian is stored under its former name, ``gaussian``.
        effect: the corruption and its parameters.
        level: row of ``effect`` in the axis's grid.
        seed: with the index of the frame, the key of all random numbers in :meth:`apply`.
    """

    axis: Literal["noise"] = "noise"
    component: Annotated[Component, BeforeValidator(current_names), PlainSerializer(stored_names)]
    effect: Effect
    seed: int

    views: ClassVar[frozenset[str]] = frozenset({"image"})
    clearance: ClassVar[float] = 0.25
    unit: ClassVar[str | None] = "steps between the benchmark's severities"
    measure: ClassVar[str] = "by the parameter that sets the strength"

    @model_validator(mode="after")
    def _component_is_that_of_effect(self) -> NoisePerturbation:
        """Check that ``component`` is the effect's component."""
        if self.component != self.effect.component:
            raise ValueError(f"component is {self.component!r}, but the effect's parameters are {self.effect!r}")
        return self

    def apply(self, frame: Frame, frame_index: int) -> Frame:
        """Return a corrupted copy of one frame.

        Parameters are pixels of a frame of ``SIZE_PX``, as in the benchmark. Frames of another size are resized to it,
        corrupted, and resized back: they look like corrupted frames of this size that were resized.

        Args:
            frame: (H, W, 3) RGB in the raw orientation of the simulator, *before* the rotation by 180 degrees. The
                benchmark corrupts at this point, and motion, fog and glass are not symmetric under the rotation.
            frame_index: index of the frame in its episode; each index has random numbers of its own.
        """
        rng = seeding.rng(self.seed, "noise", frame_index)
        height, width, _ = frame.shape
        if (height, width) == (SIZE_PX, SIZE_PX):
            return self.effect.apply(frame, rng)
        corrupted = self.effect.apply(_scaled(frame, SIZE_PX, SIZE_PX), rng)
        return _scaled(corrupted, height, width)

    def distances(self, test: TestSet, task: Task) -> Floats:
        """Return the distances to the component's test severities of all tasks: 0.5 is half way to the next severity.

        The clearance allows the middle half between two severities. Parameters that do not set the strength are not
        compared, so an equal strength counts as equal.
        """
        tested, severities = _tested(test, self.component, self.effect.strength[0])
        return np.abs(severities - self.severity(test)) if tested else severities

    def distances_to(self, others: Sequence[NoisePerturbation]) -> Floats:
        """Return the distances (N,) to perturbations of this component, on the scale of the benchmark's severities.

        A distance is NaN if the component differs.
        """
        test = benchmark.load()
        severities = []
        for perturbation in others:
            comparable = perturbation.component == self.component
            severities.append(perturbation.severity(test) if comparable else np.nan)
        return np.abs(np.array(severities) - self.severity(test))

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the mean change of the agent view."""
        changes = episode.changes()
        if changes:
            yield f"{self.component} (mean change in grey levels)", float(changes["image"].mean())

    def severity(self, test: TestSet) -> float:
        """Return the strength on the scale of the component's test severities.

        It is 0 for a clean frame, and NaN if the component has no test tasks.
        """
        name, clean = self.effect.strength
        tested, _ = _tested(test, self.component, name)
        if not tested:
            return math.nan
        steps = (clean, *tested)
        value = float(getattr(self.effect, name))
        # Beyond the strongest severity the last step is continued.
        upper = min(max(bisect.bisect_left(steps, value), 1), len(tested))
        return upper - (steps[upper] - value) / (steps[upper] - steps[upper - 1])


def _scaled(frame: Frame, height: int, width: int) -> Frame:
    """Scale a frame (H, W, 3): smaller by the mean of the covered pixels, larger linearly."""
    import cv2  # takes long, and every process of a run imports the axes

    is_smaller = height * width < frame.shape[0] * frame.shape[1]
    return np.asarray(
        cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR), np.uint8
    )


@cache
def _tested(test: TestSet, component: Component, name: str) -> tuple[tuple[float, ...], Floats]:
    """Collect the values of a parameter in a component's test tasks.

    Returns:
        The distinct values, ascending. The place of each noise task's value among them (N,), counted from 1; NaN for
        test tasks of other components.
    """
    values = [float(t.parameters[name]) if t.component == component else np.nan for t in test.on_axis("noise")]
    ascending = sorted({value for value in values if not np.isnan(value)})
    places = [np.nan if np.isnan(value) else 1.0 + ascending.index(value) for value in values]
    return tuple(ascending), np.array(places)


def _grid(effect: type[E], **parameters: ByLevel[float]) -> ByLevel[E]:
    """Build an effect at five levels from one column of values per parameter."""
    effects = [effect(**dict(zip(parameters, row, strict=True))) for row in zip(*parameters.values(), strict=True)]
    first, second, third, fourth, fifth = effects
    return first, second, third, fourth, fifth


class NoiseAxis(Axis):
    """Parameters of each corruption at each level.

    By default, level k has values between the severities 2k - 1 and 2k of LIBERO-Plus's ten, and never their values.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
        components: Corruptions to sample, each entry with equal probability; all five by default.
        motion: Parameters of motion blur at each level.
        gaussian_blur: Parameters of Gaussian blur at each level.
        zoom: Parameters of zoom blur at each level.
        fog: Parameters of fog at each level.
        glass: Parameters of frosted glass at each level.
    """

    kinds: ClassVar = (NoisePerturbation,)
    colour: ClassVar = "#9467d6"
    dimension: ClassVar = "noise"

    former_fields: ClassVar[Mapping[str, str]] = {"gaussian": "gaussian_blur"}

    components: Annotated[tuple[Annotated[Component, BeforeValidator(current_names)], ...], Field(min_length=1)] = (
        get_args(Component)
    )
    motion: ByLevel[Motion] = _grid(Motion, radius_px=(7, 11, 17, 23, 33), sigma_px=(2.5, 4.5, 7, 11, 17.5))
    gaussian_blur: ByLevel[Gaussian] = _grid(Gaussian, sigma_px=(1.5, 3.5, 5.5, 7.5, 9.5))
    zoom: ByLevel[Zoom] = _grid(Zoom, max_scale=(1.13, 1.22, 1.33, 1.42, 1.52), copies=(14, 12, 23, 22, 27))
    fog: ByLevel[Fog] = _grid(Fog, density=(0.75, 1.75, 2.75, 3.75, 4.75), roughness_decay=(2.9, 2.35, 1.9, 1.55, 1.35))
    glass: ByLevel[Glass] = _grid(
        Glass, sigma_px=(0.6, 0.95, 1.2, 1.65, 2.35), delta_px=(1, 2, 3, 4, 5), passes=(3, 3, 2, 2, 1)
    )

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the level by the severity; two severities make one level."""
        return level_from(float(tested.parameters["severity"]) / 2)

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> NoisePerturbation:
        """Sample a component and a level, each with equal probability, independent of ``task`` and ``entry_index``."""
        grid = self._grids[pick(rng, self.components)]
        level = self.sample_level(rng)
        effect = grid[level - 1]
        seed = int(rng.integers(2**53))  # every JSON reader keeps such an integer exactly
        return NoisePerturbation(component=effect.component, effect=effect, level=level, seed=seed)

    @property
    def _grids(self) -> dict[Component, ByLevel[Effect]]:
        """Grid of each component."""
        return {
            "motion": self.motion,
            "gaussian_blur": self.gaussian_blur,
            "zoom": self.zoom,
            "fog": self.fog,
            "glass": self.glass,
        }

    def reject_levels_without_clearance(self, test: TestSet, task: Task) -> None:
        """Reject a row that is too near to a severity of the benchmark, because its level has no other perturbation.

        Raises:
            PipelineError: naming component and levels.
        """
        for component in dict.fromkeys(self.components):
            grid = self._grids[component]
            near = []
            for level in sorted({*self.levels}):
                effect = grid[level - 1]
                row = NoisePerturbation(component=effect.component, effect=effect, level=level, seed=0)
                if row.nearest(test, task).distance < row.clearance:
                    near.append(level)
            if near:
                name, _ = grid[0].strength
                tested = ", ".join(f"{value:g}" for value in _tested(test, component, name)[0])
                raise PipelineError(
                    f"{component} has test tasks as strong as level {', '.join(map(str, near))}",
                    where=f"plan.axes.noise.{component}",
                    expected=f"{name} at least a quarter of the way from each of {tested}",
                    remedy="change these rows, or leave these levels out of plan.axes.noise.levels",
                )

    @classmethod
    def held_out(cls) -> NoiseAxis:
        """Return the strengths of the benchmark's even severities.

        Noise has one strength for each component and level. With the default strengths, held-out perturbations would
        equal the perturbations of plans. Plans keep their clearance to the benchmark's strengths.
        """
        tests = benchmark.load().on_axis("noise")
        effects = {(test.component, test.parameters["severity"]): effect_of(test) for test in tests}
        grids = {}
        for component in dict.fromkeys(test.component for test in tests):
            grids[component] = tuple(effects[component, 2 * level] for level in LEVELS)
        return cls.model_validate(grids)

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[NoisePerturbation]], test: TestSet) -> CoveragePlots:
        """Describe a plot of the strengths of each component, on the scale of the benchmark's severities."""
        rows = {}
        for component in dict.fromkeys(task.component for task in test.on_axis("noise")):
            of_component = [item.perturbation for item in kept if item.perturbation.component == component]
            tested = [task.parameters for task in test.on_axis("noise") if task.component == component]
            severities: Floats = np.unique([float(parameters["severity"]) for parameters in tested])
            at = np.array([])
            if of_component:
                name, clean = of_component[0].effect.strength
                ladder = sorted({(float(parameters["severity"]), float(parameters[name])) for parameters in tested})
                steps, values = np.array([(0.0, float(clean)), *ladder]).T
                at = np.interp([float(getattr(p.effect, name)) for p in of_component], values, steps)
            rows[component.replace("_", " ")] = {BENCHMARK: severities, "noise": at}
        return CoveragePlots(
            f"{len(test.on_axis('noise')):,} test tasks at ten severities of each component. Strengths are converted "
            "to the benchmark's scale of severities.",
            [Strips("Strength by component", rows, "severity")],
        )


def effect_of(test: TestTask) -> dict[str, Value]:
    """Return the parameters of a noise task's corruption."""
    return {name: value for name, value in test.parameters.items() if name != "severity"}
