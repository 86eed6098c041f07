"""A row of noise that is as strong as a severity of the benchmark would never be sampled: it is rejected."""

import pytest

from pipeline.axes import Axes
from pipeline.axes.noise import NoiseAxis
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.planning import plan
from pipeline.report.preview import variants
from pipeline.testset import benchmark

# The benchmark blurs with a sigma of 1, 2, ..., 10 pixels.
ROWS = [{"sigma_px": sigma} for sigma in (1, 3, 4.8, 7.1, 8.5)]
STOVE = find_task("libero_goal", "turn_on_the_stove")


@pytest.mark.parametrize(("levels", "named"), [((5, 4, 3, 2, 1), "1, 2, 3, 4"), ((5, 2), "2"), ((5,), None)])
def test_levels_that_are_in_the_test_set_are_named(levels: tuple[int, ...], named: str | None) -> None:
    axis = NoiseAxis.model_validate({"gaussian_blur": ROWS, "levels": levels})
    config = PlanConfig(axes=Axes(noise=axis), episodes={"noise": 10})
    demo = StarterSource().demonstration(STOVE)
    entries, test = StarterSource().index([STOVE]).entries, benchmark.load()
    if named is None:
        assert {row.level for row in plan.make(entries, config, ReplayConfig(), test) if row.axis == "noise"} == {"5"}
        return
    told = f"noise.gaussian_blur: gaussian_blur has test tasks as strong as level {named}\n"
    with pytest.raises(PipelineError, match=told):
        plan.make(entries, config, ReplayConfig(), test)
    with pytest.raises(PipelineError, match=told):
        variants("noise", axis, demo, 0, test)
