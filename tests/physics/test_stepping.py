import numpy as np
import pytest
from short_demonstrations import MILK, STOVE, starter_demo

from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import DUMMY_ACTION, Environment
from pipeline.types import Floats, Task, Trajectory

DRAWER = find_task(
    "libero_spatial", "pick_up_the_black_bowl_in_the_top_drawer_of_the_wooden_cabinet_and_place_it_on_the_plate"
)
MICROWAVE = find_task("libero_10", "KITCHEN_SCENE6_put_the_yellow_and_white_mug_in_the_microwave_and_close_it")


def steps(environment: Environment, actions: Floats, liberos: bool) -> tuple[Floats, Floats, list[bool]]:
    """States (K, S), opacities of sites (K, nsite) and success (K,) after each action, by our step or LIBERO's own."""
    states, alphas, succeeded = [], [], []
    for action in actions:
        if liberos:
            environment._env.step(action)
        else:
            environment.step(action)
        states.append(environment.state)
        alphas.append(environment.site_alpha)
        succeeded.append(environment.succeeded())
    return np.stack(states), np.stack(alphas), succeeded


@pytest.mark.parametrize("task", [STOVE, MILK], ids=lambda task: task.name)
def test_whole_demonstrations_are_liberos_bit_for_bit(task: Task, whole: dict[Task, Trajectory]) -> None:
    ours = whole[task]
    environment = Environment(task)
    environment.restore(ours.scene)
    settled, _, _ = steps(environment, np.tile(DUMMY_ACTION, (10, 1)), liberos=True)
    states, alphas, succeeded = steps(environment, ours.actions, liberos=True)
    environment.close()
    assert np.array_equal(ours.states[0], settled[-1])
    assert np.array_equal(ours.states[1:], states)
    assert np.array_equal(ours.site_alpha[1:], alphas)
    assert ours.verdict.kept == succeeded[-1]
    assert (len(np.unique(alphas, axis=0)) > 1) == (task == STOVE), "the stove's burner is lit on the way"


@pytest.mark.slow
@pytest.mark.parametrize("task", [DRAWER, MICROWAVE], ids=["drawer", "microwave"])
def test_actions_beyond_their_limits_are_liberos_bit_for_bit(task: Task) -> None:
    environment, demo = Environment(task), starter_demo(task)
    model_xml = environment.place_fixtures(0)
    # Four times too large: the controller clips, and the arm meets its joint limits and whatever stands in its way.
    actions = demo.actions[:30] * [4, 4, 4, 4, 4, 4, 1]
    assert (np.abs(actions[:, :6]) > 1).any(axis=1).mean() > 0.5
    results = []
    for liberos in (False, True):
        environment.restore(recorded_start(demo, model_xml))
        results.append(steps(environment, actions, liberos))
    environment.close()
    assert np.array_equal(results[0][0], results[1][0])
    assert results[0][2] == results[1][2]
