"""Motions and traces against movements and cameras whose words and pixels are known."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic import IDS, episode

from pipeline.formats.annotations import event_annotations, persistent_annotations
from pipeline.libero.assets import libero_folder
from pipeline.types import Episode, Geometry

INTRINSICS = np.array([[100, 0, 128], [0, 100, 128], [0, 0, 1]], np.float32)


def moving(
    step_m: tuple[float, float, float], turn_deg: tuple[float, float, float], grip: NDArray[np.float32]
) -> Episode:
    """A hand that moves and turns evenly in the world, from one metre above a camera that looks upwards."""
    steps = np.arange(len(grip))[:, None]
    turned = Rotation.from_euler("x", 180, degrees=True)
    state = np.zeros((len(grip), 8), np.float32)
    state[:, :3] = np.array([0.0, 0.0, 1.0]) + steps * np.array(step_m)
    state[:, 3:6] = (Rotation.from_rotvec(steps * np.array(turn_deg), degrees=True) * turned).as_rotvec()
    action = np.zeros((len(grip), 7), np.float32)
    action[:, 6] = grip
    still = np.zeros((len(grip), 7), np.float32)
    seen = Geometry(INTRINSICS, np.eye(4, dtype=np.float32))
    made = replace(episode(IDS[0]), state=state, action=action, joint_state=still, rewrites=(), subtasks=())
    return replace(made, geometry={"image": seen, "wrist_image": seen})


def motions(made: Episode) -> list[tuple[int, str]]:
    return [(note.step, note.text) for note in persistent_annotations(made, train=True) if note.style == "motion"]


OPEN, CLOSED = np.full(20, -1, np.float32), np.full(20, 1, np.float32)


@pytest.mark.parametrize(
    ("step_mm", "turn_deg", "grip", "expected"),
    [
        ((5, 0, 0), (0, 0, 0), OPEN, [(0, "move forward")]),
        ((-5, 0, 0), (0, 0, 0), OPEN, [(0, "move backward")]),
        ((0, 5, 0), (0, 0, 0), OPEN, [(0, "move right")]),
        ((0, -5, 0), (0, 0, 0), CLOSED, [(0, "move left")]),
        ((2, 3, -4), (0, 0, 0), OPEN, [(0, "move down and right and forward")]),
        ((0.9, 0, 0.5), (0, 0, 0), OPEN, [(0, "stay")]),
        ((0, 0, 0), (0, 0, 2), OPEN, [(0, "turn counterclockwise")]),
        ((0, 0, 0), (0, 0, -2), OPEN, [(0, "turn clockwise")]),
        ((0, 0, 0), (2, 0, 1), OPEN, [(0, "tilt")]),
        ((0, 0, 0), (0, 0, 0.9), OPEN, [(0, "stay")]),
        ((0, 0, 2), (0, 0, 2), np.hstack([OPEN[:14], CLOSED[:6]]), [
            (0, "move up, turn counterclockwise"),
            (10, "move up, turn counterclockwise, close the gripper"),
        ]),
        ((0, 0, 0), (0, 0, 0), np.hstack([CLOSED[:10], OPEN]), [(0, "stay"), (10, "open the gripper"), (20, "stay")]),
    ],
)  # fmt: skip
def test_a_movement_is_in_words(
    step_mm: tuple[float, float, float],
    turn_deg: tuple[float, float, float],
    grip: NDArray[np.float32],
    expected: list[tuple[int, str]],
) -> None:
    x, y, z = step_mm
    assert motions(moving((x / 1000, y / 1000, z / 1000), turn_deg, grip)) == expected


@pytest.mark.parametrize("steps", [1, 5, 9, 10, 11, *range(19, 32)])
def test_an_even_movement_has_one_text_whatever_the_length_of_the_episode(steps: int) -> None:
    """The steps after the last whole half second are too few to name a direction."""
    made = moving((0.005, 0.0, 0.0), (0, 0, 0), np.full(steps, -1, np.float32))
    assert motions(made) == [(0, "move forward" if steps > 2 else "stay")]


@pytest.mark.parametrize(("step_mm", "text"), [(1.05, "move forward"), (0.95, "stay")])
def test_a_centimetre_in_half_a_second_is_a_movement(step_mm: float, text: str) -> None:
    """Twenty-one states have two windows, both of ten steps."""
    made = moving((step_mm / 1000, 0.0, 0.0), (0, 0, 0), np.full(21, -1, np.float32))
    assert motions(made) == [(0, text)]


def test_a_release_in_the_last_steps_is_part_of_the_last_text() -> None:
    grip = np.hstack([np.full(22, 1, np.float32), np.full(3, -1, np.float32)])
    assert motions(moving((0.0, 0.0, 0.0), (0, 0, 0), grip)) == [(0, "stay"), (10, "open the gripper")]


def test_left_is_the_left_of_libero_s_instructions() -> None:
    """LIBERO's own files place each thing that a name calls left or right: 52 pairs of regions."""
    places = re.compile(r"\((\w+)_(left|right)(\w*_region)\s+\(:target \w+\)\s+\(:ranges \(\s*\(([-.\d ]+)\)")
    pairs: list[tuple[float, float]] = []
    for file in sorted((libero_folder() / "bddl_files").glob("libero_*/*.bddl")):
        middle_m: dict[tuple[str, str], dict[str, float]] = {}
        for name, side, rest, numbers in places.findall(file.read_text()):
            _, low_m, _, high_m = map(float, numbers.split())
            middle_m.setdefault((name, rest), {})[side] = (low_m + high_m) / 2
        pairs += [(sides["left"], sides["right"]) for sides in middle_m.values() if len(sides) == 2]
    assert len(pairs) == 52
    for left_m, right_m in pairs:
        towards = (left_m - right_m) / 20
        assert motions(moving((0.0, towards, 0.0), (0, 0, 0), OPEN)) == [(0, "move left")]


def test_a_trace_is_where_the_gripper_goes_within_two_seconds() -> None:
    made = moving((0.01, 0.02, 0.0), (0, 0, 0), np.full(60, -1, np.float32))
    notes = event_annotations(made, 256)
    # The last one, at step 50, has steps 50, 54 and 58: 178 and 228 pixels, 182 and 236, 186 and 244.
    assert [(note.step, note.camera) for note in notes] == [
        (step, "observation.images.image") for step in range(0, 60, 10)
    ]
    first, last = (json.loads(notes[place].text) for place in (0, -1))
    assert first == {
        "label": "gripper",
        "point_format": "xy",
        "points": [[128 + 4 * k, 128 + 8 * k] for k in range(11)],
    }
    assert last["points"] == [[178, 228], [182, 236], [186, 244]]


def test_points_outside_of_the_picture_and_behind_the_camera_are_left_out() -> None:
    leaves = moving((0.04, 0.0, 0.0), (0, 0, 0), np.full(41, -1, np.float32))
    traces = [json.loads(note.text)["points"] for note in event_annotations(leaves, 256)]
    # 255 pixels are the last ones inside; at step 30 the first point alone is (248, 128).
    assert traces == [
        [[128 + 16 * k, 128] for k in range(8)],
        [[168 + 16 * k, 128] for k in range(6)],
        [[208 + 16 * k, 128] for k in range(3)],
    ]
    (note, *_) = event_annotations(leaves, 170)
    assert json.loads(note.text)["points"] == [
        [128, 128],
        [144, 128],
        [160, 128],
    ]
    behind = moving((0.0, 0.0, -0.26), (0, 0, 0), np.full(20, -1, np.float32))
    assert event_annotations(behind, 256) == []
