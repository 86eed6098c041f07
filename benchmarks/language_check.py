"""Reliability of the check of rewrites: how often it accepts a rewrite of one task for another task of the scene.

    python benchmarks/language_check.py

Every rewrite of the bank is checked against every other task of its scene whose goal its own goal does not include. An
accepted pair is a miss: the text asks for something else. The last line is JSON.
"""

import json
from collections import defaultdict

from pipeline.axes.language import load_bank
from pipeline.axes.language_lint import lint
from pipeline.libero import bddl
from pipeline.libero.tasks import SUITES, tasks
from pipeline.machine_code import ensure_fixed_machine_code


def main() -> None:
    problems = {task: bddl.read(task.bddl_file) for suite in SUITES for task in tasks(suite)}
    of_scene = defaultdict(list)
    for task, problem in problems.items():
        of_scene[problem.scene].append(task)
    pairs: dict[str, int] = defaultdict(int)
    accepted: dict[str, int] = defaultdict(int)
    bank = load_bank()
    for task, problem in problems.items():
        for component, texts in bank.get(task.suite, {}).get(task.name, {}).items():
            for other in of_scene[problem.scene]:
                # The goal of `other`, as atoms; a text that asks for more than it would be right for both.
                if other == task or problems[other].asked[1] <= problem.asked[1]:
                    continue
                for text in texts:
                    pairs[component] += 1
                    if lint(text, other, component) is None:
                        accepted[component] += 1
                        print(f"{other.instruction!r} accepts {text!r}")
    total = {"pairs": sum(pairs.values()), "accepted": sum(accepted.values())}
    print(json.dumps({**total, "pairs_by_component": pairs, "accepted_by_component": accepted}))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
