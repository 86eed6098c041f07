"""Statistics are exact, over every step of every episode, and each client gets them in its own convention."""

import numpy as np
import pytest

from pipeline import seeding
from pipeline.formats import exact_statistics
from pipeline.formats.exact_statistics import Motion


@pytest.fixture
def episodes() -> list[Motion]:
    """Episodes of very different lengths and ranges, so that a mean of per-episode figures is far off."""
    rng = seeding.rng("test_stats")
    made = []
    for steps, scale in ((400, 0.1), (9, 1.0), (60, 0.4)):
        action = rng.uniform(-scale, scale, (steps, 7)).astype(np.float32)
        action[:, 6] = np.where(np.arange(steps) < steps // 3, -1, 1)
        made.append((action, rng.normal(scale, scale, (steps, 8)).astype(np.float32)))
    return made


def test_openvla_measures_every_step_once(episodes: list[Motion]) -> None:
    found = exact_statistics.openvla(episodes)
    rows = np.array([row for action, _ in episodes for row in action.astype(np.float64)])
    assert (found["num_transitions"], found["num_trajectories"]) == (469, 3)
    for dimension in range(6):
        column = sorted(rows[:, dimension])
        assert found["action"]["mean"][dimension] == pytest.approx(sum(column) / 469, abs=1e-12)
        assert found["action"]["min"][dimension] == column[0]
        assert found["action"]["max"][dimension] == column[-1]
        squares = sum((value - sum(column) / 469) ** 2 for value in column)
        assert found["action"]["std"][dimension] == pytest.approx((squares / 469) ** 0.5, abs=1e-12)
        # Places 4.68 and 463.32 of 0 to 468, between their two neighbours.
        low, high = column[4] + 0.68 * (column[5] - column[4]), column[463] + 0.32 * (column[464] - column[463])
        assert [found["action"][name][dimension] for name in ("q01", "q99")] == pytest.approx([low, high], abs=1e-12)
    means = np.mean([state.mean(0) for _, state in episodes], axis=0)
    assert np.abs(np.array(found["proprio"]["mean"]) - means).min() > 0.05, "not a mean of means"


def test_gripper_is_turned_for_openvla_and_left_for_openpi(episodes: list[Motion]) -> None:
    commands = np.concatenate([action[:, 6] for action, _ in episodes])
    openvla = exact_statistics.openvla(episodes)["action"]
    assert openvla["mean"][6] == pytest.approx((commands == -1).mean())
    assert (openvla["min"][6], openvla["max"][6]) == (0.0, 1.0)
    assert openvla["mask"] == [True] * 6 + [False]
    actions, states = (np.concatenate(column) for column in zip(*episodes, strict=True))
    openpi = exact_statistics.openpi(actions, states)["norm_stats"]
    assert openpi["actions"]["mean"][6] == pytest.approx(commands.mean())
    assert openpi["actions"]["q99"][:6] == openvla["q99"][:6]
    assert set(openpi["state"]) == {"mean", "std", "q01", "q99"}


def test_open_is_one_leaves_its_argument_alone(episodes: list[Motion]) -> None:
    action, _ = episodes[0]
    before = action.copy()
    turned = exact_statistics.open_is_one(action)
    assert np.array_equal(action, before)
    assert np.array_equal(turned[:, :6], before[:, :6])
    assert turned.dtype == np.float32
