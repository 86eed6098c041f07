"""The starter set has a demonstration of every task, and is listed without a simulator."""

from pathlib import Path

import numpy as np
import pytest
from recordings import NAME, TASK, run

from pipeline.errors import PipelineError
from pipeline.libero.assets import package_folder
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import select_tasks, tasks

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")


def test_starter_set_has_every_task() -> None:
    source = StarterSource()
    index = source.index(select_tasks([f"{suite}/*" for suite in SUITES]))
    assert len(index.entries) == 40
    assert not index.problems
    for entry in index.entries:
        demo = source.load(entry.demo_id)
        assert (demo.demo_id, demo.sha256, len(demo.actions)) == (entry.demo_id, entry.sha256, entry.steps)
        assert demo.actions.shape[1] == 7
        assert set(np.unique(demo.actions[:, 6])) <= {-1.0, 1.0}
        # Time, then the robot's nine positions and the scene's, then about as many velocities.
        assert 1 + 9 + 9 < len(demo.init_state) < 130
        assert demo.model_xml is None
        assert f"{demo.task.suite}/{demo.task.name}_demo.hdf5" in demo.source
    assert len({entry.sha256 for entry in index.entries}) == 40
    assert len(source.index(tasks("libero_90")).entries) == 90


@pytest.mark.parametrize(
    ("demo_id", "what"),
    [
        (f"{NAME}/demo_77", "has no"),
        ("libero_goal/turn_on_the_stove", "not a demonstration's id"),
        ("libero_goal/../x", "no task '..'"),
        ("libero_none/a/demo_0", "unknown suite"),
    ],
)
def test_the_starter_set_rejects_unknown_ids(demo_id: str, what: str) -> None:
    with pytest.raises(PipelineError, match=what):
        StarterSource().load(demo_id)


def test_missing_starter_package_names_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not one by pip, which may change other packages that are pinned."""
    with monkeypatch.context() as context:
        context.setattr("pipeline.libero.demonstrations.package_folder", lambda _: tmp_path)
        with pytest.raises(
            PipelineError, match=r"no starter demonstration of (?s:.*)try: mv \.venv \.venv\.old && bash setup"
        ):
            StarterSource().index([TASK])
    monkeypatch.setattr("pipeline.libero.assets.find_spec", lambda _: None)
    package_folder.cache_clear()
    with pytest.raises(PipelineError, match=r"robouse is not installed\n  try: mv \.venv \.venv\.old && bash setup"):
        StarterSource().index([TASK])


def test_import_is_quiet_and_needs_no_simulator(tmp_path: Path) -> None:
    code = """
import sys
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import tasks
StarterSource().index(tasks("libero_goal")[:2])
print(sorted({"mujoco", "robosuite", "torch", "robouse"} & set(sys.modules)))
"""
    unset = {"LIBERO_CONFIG_PATH": "", "XDG_CONFIG_HOME": "", "XDG_CACHE_HOME": ""}
    assert run(code, HOME=str(tmp_path), **unset) == "[]\n"
    assert list(tmp_path.iterdir()) == []
