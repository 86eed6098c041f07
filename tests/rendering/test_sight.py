"""No camera of a test task is rejected for the hand; one that shows less of it than all of them is."""

import numpy as np
import pytest
from arenas import TASKS
from checkout import REPOSITORY
from short_demonstrations import starter_demo

from pipeline.axes.camera import CameraPerturbation
from pipeline.config import ReplayConfig
from pipeline.evaluation import libero_plus
from pipeline.physics.environment import environment_of
from pipeline.physics.replay import replay
from pipeline.planning.streams import Stream
from pipeline.rendering.renderer import LastScene
from pipeline.rendering.sight import FirstFrame
from pipeline.testset import benchmark

STUDY = TASKS["study"]


@pytest.mark.slow
def test_no_test_camera_of_the_study_loses_the_hand(opened: LastScene) -> None:
    """All 27 spherical ones lose it for up to 58 % of the steps; LIBERO's own for none."""
    trajectory = replay(environment_of(STUDY), starter_demo(STUDY), "study", ReplayConfig(mode="open_loop"))
    renderer = opened.renderer(trajectory.model_xml)
    hand_m = []
    for state, alpha in zip(trajectory.states[:-1], trajectory.site_alpha[:-1], strict=True):
        renderer.restore(state, alpha)
        hand_m.append(renderer.data.site("gripper0_grip_site").xpos.copy())
    first_frame = FirstFrame(renderer, trajectory, STUDY, np.stack(hand_m))
    tests = [
        test
        for test in benchmark.load(REPOSITORY / benchmark.FOLDER).on(STUDY, "camera")
        if "spherical" in test.component
    ]
    assert len(tests) == 27
    for test in tests[::9]:
        moved = (libero_plus.camera(test),)
        with renderer.perturbed(moved):
            assert first_frame.fault([Stream("image", moved)]) is None, test.name
    away = (CameraPerturbation(component="spherical", level=5, elevation_deg=15.0, pitch_deg=18.0),)
    with renderer.perturbed(away):
        assert first_frame.fault([Stream("image", away)]) == "hand_not_seen"
