"""No number that a configuration may say stops a run: every field of every axis, at the ends of what is accepted."""

import copy
import struct
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.axes import AXES, Axes, Axis, Perturbation, PixelPerturbation, RenderPerturbation, from_json, to_json
from pipeline.axes.background import BackgroundPerturbation
from pipeline.axes.base import sample_number
from pipeline.axes.pose import PoseAxis
from pipeline.errors import PipelineError
from pipeline.libero.tasks import SUITES, tasks
from pipeline.seeding import rng
from pipeline.testset.benchmark import TestSet
from pipeline.types import Task

Path = tuple[str | int, ...]

TASKS = [task for suite in SUITES for task in tasks(suite)[::9]]
"""Of all suites and arenas."""
FRAME = np.random.default_rng(0).integers(0, 256, (256, 256, 3), np.uint8)
ROOM = """
<mujoco><asset><material name="plain"/></asset><worldbody>
  <light pos="1 1 3" dir="-1 -1 -3"/><light directional="true" dir="0 1 -1"/>
  <camera name="agentview" pos="1 0 1.5" quat="0.6 0.3 0.3 0.6"/><geom size="1" material="plain"/>
</worldbody></mujoco>"""


def fields(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """The numbers in a configuration, and the intervals as wholes; of a list the first and the last."""
    match value:
        case dict():
            for name, member in value.items():
                yield from fields(member, (*path, name))
        case [float(), float()] if isinstance(path[-1], int):
            yield path, value
        case list():
            for index in dict.fromkeys((0, len(value) - 1)):
                yield from fields(value[index], (*path, index))
        case int() | float():
            yield path, value


def changed(config: dict[str, Any], path: Path, value: Any) -> dict[str, Any]:
    config = copy.deepcopy(config)
    section: Any = config
    for key in path[:-1]:
        section = section[key]
    section[path[-1]] = value
    return config


def end(accepts: Callable[[Any], bool], start: float, far: float) -> Any:
    """The last accepted number on the way from ``start`` to ``far``, to the last bit."""
    whole = isinstance(start, int)
    near, beyond = (int(start), int(far)) if whole else (place(start), place(far))
    number: Callable[[int], Any] = int if whole else at
    while abs(beyond - near) > 1:
        middle = (near + beyond) // 2
        near, beyond = (middle, beyond) if accepts(number(middle)) else (near, middle)
    return number(near)


def place(number: float) -> int:
    """Of a float among all floats in ascending order."""
    (bits,) = struct.unpack("<q", struct.pack("<d", number))
    return int(bits) if bits >= 0 else -(int(bits) & (2**63 - 1))


def at(place: int) -> float:
    bits = place if place >= 0 else -place - 2**63
    (number,) = struct.unpack("<d", struct.pack("<q", bits))
    return float(number)


def ends(name: str, config: dict[str, Any], path: Path, value: Any) -> Iterator[dict[str, Any]]:
    """Configurations of an axis with one field at the least and at the greatest that is accepted."""

    # An interval alone, as intervals may not overlap.
    if isinstance(value, list):
        config, path = changed(config, path[:-1], [value]), (*path[:-1], 0)

    def accepts(number: Any) -> bool:
        try:
            Axes.model_validate({name: changed(config, path, [number] * 2 if isinstance(value, list) else number)})
        except ValidationError:
            return False
        return True

    start = value[0] if isinstance(value, list) else value
    far = 2**70 if isinstance(start, int) else 1.7e308
    low, high = end(accepts, start, -far), end(accepts, start, far)
    for number in ([low, low], [low, high], [high, high]) if isinstance(value, list) else (low, high):
        yield changed(config, path, number)


@cache
def applied(json: str) -> None:
    """Let a recorded perturbation act on a frame or a small model."""
    for perturbation in from_json(json):
        if isinstance(perturbation, PixelPerturbation):
            assert perturbation.apply(FRAME, 0).shape == FRAME.shape
        elif isinstance(perturbation, RenderPerturbation) and not isinstance(perturbation, BackgroundPerturbation):
            model = mujoco.MjModel.from_xml_string(ROOM)
            perturbation.apply(model)
            assert all(np.isfinite(getattr(model, name)).all() for name in perturbation.fields)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", [name for name in AXES if name != "language"])
def test_accepted_ranges_are_sampled_recorded_and_applied(name: str) -> None:
    """Language has no numbers but its levels."""
    config = getattr(Axes.model_validate({name: {}}), name).model_dump(mode="json")
    for path, value in fields(config):
        for extreme in ends(name, config, path, value):
            axis: Axis = getattr(Axes.model_validate({name: extreme}), name)
            # So many that a change of one of five components at one of five levels is among them.
            for key in range(20 if name == "layout" else 120):
                task = TASKS[key % len(TASKS)]
                # How large things are that go with a task, its scene alone tells: that is said in words.
                with suppress(PipelineError) if name == "layout" else nullcontext():
                    if axis.applies(task):
                        applied(recorded(axis.sample(rng("extreme", key), task, key), task))


def test_of_points_alone_each_comes() -> None:
    """No length of theirs says how often."""
    numbers = [sample_number(rng("points", number), ((-30.0, -30.0), (10.0, 10.0))) for number in range(100)]
    assert 30 < numbers.count(-30.0) < 70
    assert set(numbers) == {-30.0, 10.0}
    assert sample_number(rng("point"), ((5.0, 5.0),)) == 5.0


def recorded(perturbation: Perturbation, task: Task) -> str:
    """As a plan has it, but all under one seed, so that the same change is applied once."""
    assert perturbation.nearest(TestSet(()), task).compared == 0
    one_seed = (
        perturbation.model_copy(update={"seed": 0}) if "seed" in type(perturbation).model_fields else perturbation
    )
    return to_json(from_json(to_json([one_seed])))


def test_every_task_has_a_perturbation_of_every_component_of_pose() -> None:
    for task in (task for suite in SUITES for task in tasks(suite)):
        for component in ("target", "receptacle", "scene"):
            axis = PoseAxis.model_validate({"components": [component]})
            if axis.applies(task):
                (perturbation,) = from_json(to_json([axis.sample(rng("every"), task, 0)]))
                assert perturbation.component == component
