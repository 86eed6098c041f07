"""Texts that lerobot's own unchanged renderer gives for each frame of a dataset with language columns, counted.

The script needs lerobot 0.6 or later (``pip install 'lerobot[dataset,training]==0.6.1'``), and nothing of this project.
ROOT is a LeRobot dataset of a run with ``export.lerobot.language``:

    python benchmarks/clients/read_language.py ROOT

The recipe asks for the task and for the subtask that is active at the frame's time. The renderer takes the task from
the rewrites, if there are any. The training of lerobot 0.6.1 calls ``RenderMessagesStep``, which passes the frame's own
task; that task comes before any rewrite. The texts of ``RenderMessagesStep`` are therefore counted separately.
"""

import sys
from collections import Counter
from pathlib import Path

from lerobot.configs.recipe import MessageTurn, TrainingRecipe
from lerobot.datasets.language_render import emitted_at, render_sample
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor.render_messages_processor import RenderMessagesStep

RECIPE = TrainingRecipe(
    messages=[
        MessageTurn(role="user", content="${task}", stream="high_level"),
        MessageTurn(role="assistant", content="${subtask}", stream="low_level", target=True),
    ]
)


def main(root: Path) -> None:
    dataset = LeRobotDataset(root.name, root=root, video_backend="pyav")
    frames = dataset.hf_dataset  # the columns of every frame, without its videos
    tasks = dict(zip(dataset.meta.tasks["task_index"], dataset.meta.tasks.index, strict=True))
    rewritten, by_step, answers = 0, 0, Counter[tuple[int, str]]()
    for index in range(len(frames)):
        frame = frames[index]
        said, at_s, task = frame["language_persistent"], float(frame["timestamp"]), tasks[int(frame["task_index"])]
        emitted_at(at_s, persistent=said, events=[], style="subtask")  # fails if two begin too near to each other
        sample = {"recipe": RECIPE, "persistent": said, "events": None, "t": at_s, "sample_idx": index}
        prompt, answer = render_sample(**sample, dataset_ctx={"task": task})["messages"]
        rewritten += prompt["content"] != task
        answers[int(frame["episode_index"]), answer["content"]] += 1
        data = {"language_persistent": said, "timestamp": at_s, "index": index, "task": task}
        step = RenderMessagesStep(recipe=RECIPE)({"complementary_data": data})
        by_step += step["complementary_data"]["messages"][0]["content"] != task
    print(f"{len(frames)} frames, {rewritten} with another wording than their task's; by RenderMessagesStep {by_step}")
    for (episode, text), count in answers.items():
        print(f"episode {episode}: {count} frames: {text}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
