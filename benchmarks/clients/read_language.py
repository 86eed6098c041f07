"""Texts that lerobot's own unchanged renderer gives for each frame of a dataset with language columns, counted.

The script needs lerobot 0.6 or later (``pip install 'lerobot[dataset,training]==0.6.1'``), and nothing of this project.
ROOT is a LeRobot dataset of a run with ``export.lerobot.language``:

    python benchmarks/clients/read_language.py ROOT [PICTURE]

The recipe asks for the task, for the subtask and the motion that are active at the frame's time, and for the trace that
begins there. The points of a trace must lie in the picture. PICTURE is a file for the first frame of the dataset, with
the points of its trace.

The renderer takes the task from the rewrites, if there are any. The training of lerobot 0.6.1 calls
``RenderMessagesStep``, which passes the frame's own task; that task comes before any rewrite. The texts of
``RenderMessagesStep`` are therefore counted separately.
"""

import json
import sys
from collections import Counter
from pathlib import Path

from lerobot.configs.recipe import MessageTurn, TrainingRecipe
from lerobot.datasets.language_render import emitted_at, render_sample
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor.render_messages_processor import RenderMessagesStep
from PIL import Image, ImageDraw

CAMERA = "observation.images.image"

RECIPE = TrainingRecipe(
    messages=[
        MessageTurn(role="user", content="${task}", stream="high_level"),
        MessageTurn(role="assistant", content="${subtask}", stream="low_level", target=True),
        MessageTurn(role="assistant", content="Motion: ${motion}.", stream="low_level", target=True),
        MessageTurn(role="assistant", content="${trace}", stream="low_level", target=True, if_present="trace"),
    ],
    bindings={
        "motion": "active_at(t, style=motion)",
        "trace": f"emitted_at(t, style=trace, camera={CAMERA})",
    },
)


def render(dataset: LeRobotDataset, index: int, picture: Path) -> None:
    """Save a frame, four times as large, with the points of its trace from white to red."""
    item = dataset[index]
    trace = emitted_at(0.0, persistent=[], events=item["language_events"], style="trace", camera=CAMERA)
    points = json.loads(trace["content"])["points"]
    pixels = (item[CAMERA].permute(1, 2, 0).numpy() * 255).round().astype("uint8")
    frame = Image.fromarray(pixels).resize((4 * pixels.shape[1], 4 * pixels.shape[0]))
    canvas = ImageDraw.Draw(frame)
    for number, (x, y) in enumerate(points):
        rest = 255 - 255 * number // len(points)
        canvas.ellipse([4 * x - 4, 4 * y - 4, 4 * x + 8, 4 * y + 8], fill=(255, rest, rest), outline=(0, 0, 0))
    frame.save(picture)


def main(root: Path, *pictures: Path) -> None:
    dataset = LeRobotDataset(root.name, root=root, video_backend="pyav")
    frames = dataset.hf_dataset  # the columns of every frame, without its videos
    tasks = dict(zip(dataset.meta.tasks["task_index"], dataset.meta.tasks.index, strict=True))
    rewritten, by_step, answers, motions = 0, 0, Counter[tuple[int, str]](), Counter[str]()
    _, height, width = dataset[0][CAMERA].shape
    traces, points = 0, 0
    for index in range(len(frames)):
        frame = frames[index]
        said, at_s, task = frame["language_persistent"], float(frame["timestamp"]), tasks[int(frame["task_index"])]
        emitted_at(at_s, persistent=said, events=[], style="subtask")  # fails if two begin too near to each other
        begun = frame["language_events"]
        sample = {"recipe": RECIPE, "persistent": said, "events": begun, "t": at_s, "sample_idx": index}
        prompt, answer, motion, *trace = render_sample(**sample, dataset_ctx={"task": task})["messages"]
        motions[motion["content"]] += 1
        for message in trace:
            path = json.loads(message["content"])["points"]
            assert all(0 <= x < width and 0 <= y < height for x, y in path)
            traces, points = traces + 1, points + len(path)
        rewritten += prompt["content"] != task
        answers[int(frame["episode_index"]), answer["content"]] += 1
        data = {"language_persistent": said, "language_events": begun, "timestamp": at_s, "index": index, "task": task}
        step = RenderMessagesStep(recipe=RECIPE)({"complementary_data": data})
        by_step += step["complementary_data"]["messages"][0]["content"] != task
    print(f"{len(frames)} frames, {rewritten} with another wording than their task's; by RenderMessagesStep {by_step}")
    for (episode, text), count in answers.items():
        print(f"episode {episode}: {count} frames: {text}")
    print(f"{traces} traces with {points} points; {len(motions)} different motions, such as {motions.most_common(3)}")
    for picture in pictures:
        render(dataset, 0, picture)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
