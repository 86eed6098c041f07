"""LIBERO-90's recordings of LIVING_ROOM_SCENE4 name an object salad_dressing_1 and not new_salad_dressing_1."""

from pathlib import Path

import numpy as np
import pytest
from short_demonstrations import starter_demo

from pipeline.config import ReplayConfig
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay

TASK = find_task("libero_90", "LIVING_ROOM_SCENE4_pick_up_the_salad_dressing_and_put_it_in_the_tray")


@pytest.mark.slow
def test_a_recording_under_the_former_name_is_replayed_as_one_under_the_new_name(tmp_path: Path) -> None:
    """The starter demonstration, and the same with the scene as it was called in the published recordings."""
    demo, environment, config = starter_demo(TASK), Environment(TASK), ReplayConfig(mode="open_loop")
    scene = environment.place_fixtures(0)
    former = scene.replace('"new_salad_dressing_1', '"salad_dressing_1')
    assert former.count('"salad_dressing_1_') > 20
    states = np.tile(demo.init_state, (len(demo.actions), 1))
    recording = hdf5.Recording(demo.actions, states, states[:, :9], former, {})
    hdf5.write(tmp_path / TASK.suite / f"{TASK.name}_demo.hdf5", TASK, [recording])
    source = HDF5Source(tmp_path)
    (entry,) = source.index([TASK]).entries
    expected = replay(environment, demo, "starter", config)
    replayed = replay(environment, source.load(entry.demo_id), "former", config)
    assert expected.verdict.kept
    assert replayed.verdict.kept
    np.testing.assert_array_equal(replayed.states, expected.states)
    environment.close()
