"""Two spatial tasks begin in one scene under exchanged names of the bowls: neither plan comes near the other's tests.

Positions are read here from the BDDL files' text, by what stands where; nothing of the comparison is used.
"""

import re
import zipfile
from collections.abc import Mapping
from itertools import islice

import numpy as np
import pytest
from checkout import REPOSITORY

from pipeline.axes.pose import PoseAxis, ScenePerturbation
from pipeline.libero.tasks import find_task
from pipeline.planning.sampler import Sampler
from pipeline.testset import benchmark
from pipeline.types import Floats, Task

FOLDER = REPOSITORY / benchmark.FOLDER
TASKS = [
    find_task("libero_spatial", f"pick_up_the_black_bowl_on_the_{place}_and_place_it_on_the_plate")
    for place in ("stove", "wooden_cabinet")
]
SUPPORTS = ("flat_stove_1", "wooden_cabinet_1")

Places = dict[tuple[str, str], Floats]
"""Category and support of a thing to where it stands (x, y) in m."""


def named_places(text: str) -> dict[str, tuple[tuple[str, str], Floats]]:
    """Name of each thing to its category and support, and to where it stands, by a BDDL file's text."""
    ranges = re.findall(r"\((\w+)\s+\(:target main_table\)\s+\(:ranges \(\s*\(([^)]*)\)", text)
    centres_m = {
        f"main_table_{name}": np.reshape(corners.split(), (2, 2)).astype(float).mean(axis=0) for name, corners in ranges
    }
    start = text[text.index("(:init") : text.index("(:goal")]
    stands = dict(re.findall(r"\(On (\w+) (\w+)\)", start))
    places = {}
    for name, place in stands.items():
        support = next((one for one in SUPPORTS if place.startswith(one)), "main_table")
        centre_m = centres_m[place if support == "main_table" else stands[support]]
        places[name] = (name.rpartition("_")[0], support), centre_m
    return places


def moved_places(task: Task, moves: Mapping[str, tuple[float, float]]) -> Places:
    """Where the things of a task stand after a plan's moves."""
    original = named_places(task.bddl_file.read_text())
    return {kind: centre_m + moves[name] for name, (kind, centre_m) in original.items()}


def scenes_of_tests(archive: zipfile.ZipFile) -> list[Places]:
    """The places of all things in the pose tests of both tasks."""
    folder = "liberoplus/liberoplus/bddl_files/libero_spatial/"
    names = [name for task in TASKS for name in archive.namelist() if name.startswith(f"{folder}{task.name}_level")]
    tested = {test.name for test in benchmark.load(FOLDER).on_axis("pose")}
    texts = [archive.read(name).decode() for name in names if name[len(folder) : -5] in tested]
    return [dict(named_places(text).values()) for text in texts]


def largest_difference_m(one: Places, other: Places) -> float:
    return max(float(np.abs(one[kind] - other[kind]).max()) for kind in one)


@pytest.mark.parametrize("task", TASKS, ids=SUPPORTS)
def test_no_sample_of_a_plan_is_within_a_centimetre_of_the_other_tasks_tests(task: Task) -> None:
    with zipfile.ZipFile(FOLDER / benchmark.WHEEL) as archive:
        scenes = scenes_of_tests(archive)
    assert len(scenes) > 30
    sampler = Sampler("pose", (PoseAxis(levels=(1,)),), 1, benchmark.load(FOLDER))
    within = 0
    for (perturbation,) in islice(sampler.sample(task.name, task), 200):
        assert isinstance(perturbation, ScenePerturbation)
        places = moved_places(task, perturbation.shifts)
        assert all(places.keys() == scene.keys() for scene in scenes)
        within += min(largest_difference_m(places, scene) for scene in scenes) < ScenePerturbation.clearance
    assert within == 0
