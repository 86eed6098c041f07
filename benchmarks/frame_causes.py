"""Matrix of the causes that ``dataset compare-frame`` reports for pictures with known causes.

    nice -n 10 python benchmarks/frame_causes.py [--only WORD]

The pictures are frames of LIBERO's own environment with MuJoCo 3.1.6, 3.3.3 and 3.8.1
(``tests/evaluation/simulator_frames/``, rendered by ``simulator_frames.py``), turned, mirrored, resized and changed
here. Nothing of the comparison is used to change them. Each case prints its expected and reported causes. The last line
is JSON: expected causes to reported causes to the number of cases, and the number of wrong cases.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.evaluation.first_observation.frame_report import Report, compare_frame
from pipeline.evaluation.first_observation.start_frames import LastStartFrames
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code

FRAMES = Path(__file__).resolve().parents[1] / "tests" / "evaluation" / "simulator_frames"

TASKS = {
    "spatial": "libero_spatial/pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate",
    "object": "libero_object/pick_up_the_alphabet_soup_and_place_it_in_the_basket",
    "goal": "libero_goal/turn_on_the_stove",
    "long": "libero_10/LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate_and_put_the_yellow_and_white_mug_on_the"
    "_right_plate",
}
"""Name of a suite in the files to the task of its frames."""

Image = NDArray[np.uint8]


class Case(NamedTuple):
    """A picture with known causes.

    Attributes:
        picture: (H, W, 3) BGR.
        causes: causes that must be reported, and no others.
        task: task that the user compares with.
    """

    name: str
    picture: Image
    causes: frozenset[str]
    task: str
    view: str = "agentview"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", default="", help="run the cases whose names have this word")
    arguments = parser.parse_args()
    matrix: dict[str, Counter[str]] = {}
    wrong = 0
    with closing(LastStartFrames()) as opened:
        for case in cases():
            if arguments.only not in case.name:
                continue
            report = reported(case, opened)
            causes = {finding.cause for finding in report.findings}
            expected, found = _joined(case.causes), _joined(causes)
            matrix.setdefault(expected, Counter())[found] += 1
            wrong += causes != case.causes
            print(f"{'' if causes == case.causes else 'WRONG '}{case.name}: {expected} -> {found}", flush=True)
            print("\n".join(f"    {line}" for line in report.lines()), file=sys.stderr, flush=True)
    print(json.dumps({"matrix": matrix, "cases": sum(map(Counter.total, matrix.values())), "wrong": wrong}))
    sys.exit(wrong > 0)


def reported(case: Case, opened: LastStartFrames, suffix: str = ".png") -> Report:
    """Compare the picture of a case through a file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"first{suffix}"
        cv2.imwrite(str(file), case.picture)
        suite, _, name = case.task.partition("/")
        return compare_frame(file, find_task(suite, name), 0, case.view, opened, lambda text: None)


def _joined(causes: Any) -> str:
    return "+".join(sorted(causes)) or "equal"


def frame(name: str) -> Image:
    """Read a frame of the folder."""
    (file,) = FRAMES.glob(f"{name}.*")
    return np.asarray(cv2.imread(str(file)), np.uint8)


def cases() -> Iterator[Case]:
    """Yield all cases, those of one task one after the other."""
    for suite, task in TASKS.items():
        clean = frame(f"3.1.6-{suite}-agentview")
        yield Case(f"{suite}: MuJoCo 3.1.6", clean, frozenset(), task)
        for version in ("3.3.3", "3.8.1"):
            # Little or nothing of the living room's floor is visible.
            causes = frozenset[str]() if suite == "long" else frozenset({"mujoco"})
            yield Case(f"{suite}: MuJoCo {version}", frame(f"{version}-{suite}-agentview"), causes, task)
        yield from _changed(suite, clean, task)
        if suite == "goal":
            yield from _starts(task)
        if suite == "object":
            yield from _further(clean, task)


def _changed(suite: str, clean: Image, task: str) -> Iterator[Case]:
    """Yield cases of a changed picture."""
    orientations: dict[str, Any] = {
        "rotated 180": cv2.rotate(clean, cv2.ROTATE_180),
        "rotated 90": cv2.rotate(clean, cv2.ROTATE_90_CLOCKWISE),
        "rotated 270": cv2.rotate(clean, cv2.ROTATE_90_COUNTERCLOCKWISE),
        "mirrored": cv2.flip(clean, 1),
        "upside down": cv2.flip(clean, 0),
        "transposed": cv2.transpose(clean),
    }
    for name, picture in orientations.items():
        yield Case(f"{suite}: {name}", picture, frozenset({"orientation"}), task)
    sizes: dict[str, Any] = {
        "224 by area": cv2.resize(clean, (224, 224), interpolation=cv2.INTER_AREA),
        "128 by linear": cv2.resize(clean, (128, 128), interpolation=cv2.INTER_LINEAR),
        "512 by cubic": cv2.resize(clean, (512, 512), interpolation=cv2.INTER_CUBIC),
    }
    for name, picture in sizes.items():
        yield Case(f"{suite}: {name}", np.asarray(picture, np.uint8), frozenset({"size"}), task)
    for quality in (90, 50):
        packed = cv2.imencode(".jpg", clean, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        yield Case(f"{suite}: JPEG {quality}", np.asarray(cv2.imdecode(packed, 1), np.uint8), frozenset(), task)
    yield Case(f"{suite}: red and blue exchanged", clean[..., ::-1].copy(), frozenset({"channels"}), task)
    brighter = cv2.convertScaleAbs(clean, alpha=0.8)
    yield Case(f"{suite}: 0.8 times as bright", np.asarray(brighter, np.uint8), frozenset({"brightness"}), task)
    cut = cv2.resize(clean[13:243, 13:243], (256, 256), interpolation=cv2.INTER_LINEAR)
    yield Case(f"{suite}: middle 90 %", np.asarray(cut, np.uint8), frozenset({"zoom"}), task)
    stretched = cv2.resize(clean, (320, 256), interpolation=cv2.INTER_LINEAR)
    yield Case(f"{suite}: stretched", np.asarray(stretched, np.uint8), frozenset({"size", "shape"}), task)


def _starts(task: str) -> Iterator[Case]:
    """Yield cases of another start, of the goal suite."""
    causes = {"steps0": "not_settled", "gripper1": "gripper", "seed7": "reset_seed", "state3": "initial_state"}
    for name, cause in causes.items():
        expected = {cause, "reset_seed"} if cause == "initial_state" else {cause}
        yield Case(f"goal: {name}", frame(f"3.1.6-goal-agentview-{name}"), frozenset(expected), task)
    unsettled = np.asarray(cv2.rotate(frame("3.1.6-goal-agentview-steps0"), cv2.ROTATE_180), np.uint8)
    yield Case("goal: steps0, rotated 180", unsettled, frozenset({"not_settled", "orientation"}), task)
    wrist = frame("3.1.6-goal-wrist")
    yield Case("goal: wrist", wrist, frozenset({"view"}), task)
    yield Case("goal: wrist as wrist", wrist, frozenset(), task, view="wrist")
    yield Case(
        "goal: wrist upside down",
        np.asarray(cv2.flip(wrist, 0), np.uint8),
        frozenset({"orientation"}),
        task,
        view="wrist",
    )
    shift = np.array([[1.0, 0.0, 14.0], [0.0, 1.0, 8.0]])
    clean = frame("3.1.6-goal-agentview")
    moved = cv2.warpAffine(clean, shift, (256, 256), borderMode=cv2.BORDER_REFLECT)
    yield Case("goal: camera shifted", np.asarray(moved, np.uint8), frozenset({"camera_pose"}), task)
    place = np.zeros((256, 256), np.uint8)
    place[128:200, 102:162] = 1
    without = cv2.inpaint(clean, place, 3, cv2.INPAINT_TELEA)
    yield Case("goal: bowl and plate removed", np.asarray(without, np.uint8), frozenset({"things"}), task)
    blue, _, red = (channel.astype(int) for channel in cv2.split(clean))
    wood = (np.arange(256)[:, None] > 140) & (red - blue > 15)
    table = np.where(wood[..., None], clean * np.array([0.8, 1.0, 0.6]), clean)
    yield Case("goal: table of another colour", np.asarray(table, np.uint8), frozenset({"colours"}), task)


def _further(clean: Image, task: str) -> Iterator[Case]:
    """Yield cases of the object suite: other size of the camera, several causes, another task, no frame at all."""
    yield Case("object: rendered with 360 pixels", frame("3.1.6-object-agentview-360"), frozenset({"size"}), task)
    darker = frame("3.8.1-object-wrist")
    yield Case("object: wrist, MuJoCo 3.8.1", darker, frozenset({"mujoco"}), task, view="wrist")
    turned = cv2.resize(cv2.rotate(frame("3.8.1-object-agentview"), cv2.ROTATE_180), (224, 224))
    three = frozenset({"mujoco", "orientation", "size"})
    yield Case("object: MuJoCo 3.8.1, rotated 180, 224", np.asarray(turned, np.uint8), three, task)
    noise = np.random.default_rng(0).integers(0, 256, (256, 256, 3), np.uint8)
    yield Case("object: random pixels", noise, frozenset({"unknown"}), task)
    other = "libero_object/pick_up_the_cream_cheese_and_place_it_in_the_basket"
    yield Case("object: of another task", clean, frozenset({"task"}), other)


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
