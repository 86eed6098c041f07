"""What a report counts and compares, by rows whose figures are known; figures, by the bytes of those that belong."""

import re
from typing import Any

import numpy as np
import pytest
from short_demonstrations import BOWL
from synthetic import IDS, episode

from pipeline.axes import to_json
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.language import LanguagePerturbation
from pipeline.axes.report_data import KeptPerturbation
from pipeline.axes.robot import RobotAxis, RobotPerturbation
from pipeline.report import coverage, figures, report, yields
from pipeline.seeding import rng
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats


def row(name: str, axis: str, steps: int | None, **other: Any) -> dict[str, Any]:
    """Of an episode on a trajectory of its own."""
    known = {"suite": BOWL.suite, "task": BOWL.name, "chosen": True, "kept": True, "reason": "kept"}
    known |= {"perturbations": "[]", "replay_mode": "open_loop", "instruction": BOWL.instruction, "wanted": True}
    role = "twin" if axis == "clean" else "perturbed"
    ids = {"episode_id": name, "trajectory_id": name, "twin_id": "twin", "actions_sha256": f"actions of {name}"}
    ids |= {"demo_id": "demonstration"}
    return {**known, **ids, "axis": axis, "role": role, "steps": steps, **other}


TWIN = row("twin", "clean", 3000)
PUSHED, LOST = row("pushed", "robot", 3120), row("lost", "robot", 50, kept=False, reason="goal_lost")
TRACKED = row("tracked", "robot", 2980, replay_mode="tracked", task="another")


def test_the_headline_is_of_what_is_kept() -> None:
    assert report._headline([TWIN, PUSHED, LOST, TRACKED], [TWIN, PUSHED, TRACKED]) == {
        **{
            "planned": "4",
            "replayed": "4",
            "kept": "3",
            "kept clean twins": "1",
            "action sequences": "3",
            "tasks": "2",
        },
        # 9,100 steps of 50 ms.
        **{"steps": "9,100", "minutes at 20 Hz": "8"},
    }


def test_action_sequences_are_counted_by_task() -> None:
    shown = row("shown", "camera", 3000, actions_sha256=TWIN["actions_sha256"])
    table = yields.by_task([TWIN, shown, PUSHED, TRACKED])
    assert table.head == ("task", "episodes", "distinct sequences", "as recorded")
    assert [[cell.text for cell in line] for line in table.rows] == [
        [f"{BOWL.suite}/another", "1", "1", "0"],
        [str(BOWL), "3", "2", "3"],
        ["all", "4", "3", "3"],
    ]


def test_replacements_from_other_demonstrations_are_shown() -> None:
    """Two of each demonstration are wanted; those of the second one fail, and a reserve of the first replaces one."""
    planned = [row(f"{demo}{number}", "robot", 9, demo_id=demo, wanted=True) for demo in "ab" for number in range(2)]
    planned += [row("spare", "robot", 9, demo_id="a", wanted=False), row("twin", "clean", 9, demo_id="b", wanted=True)]
    planned.append(row("other", "robot", 9, demo_id="c", wanted=True, task="another"))
    lost = ("b0", "b1", "other")
    table = yields.by_demonstration([one | {"kept": one["episode_id"] not in lost} for one in planned])
    assert [[cell.text for cell in line] for line in table.rows] == [
        [str(BOWL), "1/2", "50 %", "100 %"],
        [f"{BOWL.suite}/another", "0/1", "100 %", "-"],
    ]


def test_drop_reasons_are_of_what_is_lost_and_replay_modes_of_what_is_kept() -> None:
    *_, dropped, modes = yields.tables([TWIN, PUSHED, LOST, TRACKED])
    assert (dropped.head, dropped.rows) == (("axis", "goal_lost"), [(("robot", None), ("1", None))])
    assert (modes.head, [[cell.text for cell in line] for line in modes.rows]) == (
        ("axis", "open_loop", "tracked"),
        [["clean", "1", "-"], ["robot", "1", "1"]],
    )


def test_own_motion_is_next_to_that_of_the_twins() -> None:
    def actions(key: str) -> Floats:
        return rng("motion", key).uniform(-1, 1, (9, 7))

    moved = {name: actions(name) for name in ("twin", "pushed", "tracked")}
    shown = report._own_motion([TWIN, PUSHED, TRACKED], {"twin": TWIN}, moved)
    own = np.concatenate([moved["pushed"], moved["tracked"]])
    # Each twin counts as often as it is compared with.
    assert shown == {"robot": report._histograms({"clean": np.tile(moved["twin"], (2, 1)), "robot": own})}


def test_an_episode_is_longer_by_the_steps_that_its_twin_has_fewer() -> None:
    expected = figures.strips("Difference from the clean twin", {"robot": {"robot": np.array([120.0, -20.0])}}, "steps")
    rows = [TWIN, PUSHED, TRACKED]
    assert report._lengths(rows, rows)[-1] == expected


def test_what_moved_others_farthest_comes_first() -> None:
    twin, *names = IDS[:4]
    rows = [row(name, "robot", 9, twin_id=twin) for name in names]
    for one, far_m in zip(rows, (0.1, 0.3, 0.02), strict=True):
        one["non_target_moved_m"] = far_m
    shown = report._worst(rows, {twin: row(twin, "clean", 9)}, episode)  # type: ignore[arg-type]
    farthest_first = [(names[1], "30.0 cm"), (names[0], "10.0 cm"), (names[2], "2.0 cm")]
    for video, (name, moved) in zip(shown, farthest_first, strict=True):
        assert f"episode {name}: {moved}" in video.caption


def test_a_video_of_an_axis_is_of_its_strongest_episode() -> None:
    twin, *names = IDS[:4]
    moved = [RobotAxis(levels=(level,)).sample(rng("level", level), BOWL, 0) for level in (1, 5, 3)]
    texts = [to_json([one]) for one in moved]
    rows = [
        row(one, "robot", 9, twin_id=twin, perturbations=text, instruction=one)
        for one, text in zip(names, texts, strict=True)
    ]
    (video,) = report._videos(rows, {twin: row(twin, "clean", 9)}, episode)  # type: ignore[arg-type]
    assert video.instruction == names[1]


def test_a_rewrite_stands_behind_the_original() -> None:
    said = LanguagePerturbation(component="paraphrase", level=1, text="bring the bowl to the plate")
    rewritten = row("rewritten", "language", 9, perturbations=to_json([said]), instruction=said.text)
    assert report._rewrites([TWIN, rewritten]) == [("paraphrase, level 1", "put the bowl on the plate", said.text)]


def test_a_perturbation_is_plotted_at_its_parameters() -> None:
    nothing = np.empty((0, 2))
    camera = CameraPerturbation(component="spherical", level=1, azimuth_deg=10, elevation_deg=3, yaw_deg=4, pitch_deg=7)
    stands, _, turned = coverage.plot_axis("camera", [KeptPerturbation(BOWL, camera, None)], TestSet(())).panels
    groups = [{"benchmark": nothing, "camera": np.array([at])} for at in ([10.0, 3.0], [4.0, 7.0])]
    assert stands == figures.scatter("Position", groups[0], "azimuth (°)", "elevation (°)")
    assert turned == figures.scatter("Rotation in place", groups[1], "yaw (°)", "pitch (°)")
    offsets_rad = (0.1, 0.2, -0.1, 0.0, 0.05, 0.3, -0.2)
    robot = RobotPerturbation(component="initial_joints", level=1, joint_offsets_rad=offsets_rad)
    rows = {f"joint {n}": {"benchmark": nothing[:, 0], "robot": np.array([x])} for n, x in enumerate(offsets_rad, 1)}
    *_, joints = coverage.plot_axis("robot", [KeptPerturbation(BOWL, robot, None)], TestSet(())).panels
    assert joints == figures.strips("Offset of each joint, from base to wrist", rows, "rad")


@pytest.mark.parametrize(("values", "share"), [([10.5, 10.5, 10.5], 1.0), ([10.5, 11.5, 12.5], 0.35)])
def test_a_histogram_shows_shares(values: list[float], share: float) -> None:
    """All in one bin, or a third in each of three, by the uppermost number of the scale."""
    svg = figures.histogram("", {"camera": np.array(values)}, np.linspace(10, 13, 4), "").svg
    assert max(map(float, re.findall(r">(\d\.\d+)<", svg))) == share
