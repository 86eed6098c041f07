"""Cost of a control step and of a restored scene, ours and LIBERO's own, on one starter demonstration of each task.

    nice -n 10 python benchmarks/stepping.py [--tasks 'libero_goal/turn_on_the_stove' ...]

Both step the same whole demonstrations in turns of ten control steps; the cost is CPU time. Their states, lit burners
and success are compared bit for bit. The last line is the result as JSON.
"""

import argparse
import json
import time
from statistics import median

import numpy as np

from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import select_tasks
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import Environment
from pipeline.types import Demo, Floats

TASKS = (
    "libero_spatial/pick_up_the_black_bowl_in_the_top_drawer_of_the_wooden_cabinet_and_place_it_on_the_plate",
    "libero_object/pick_up_the_milk_and_place_it_in_the_basket",
    "libero_goal/turn_on_the_stove",
    "libero_goal/open_the_top_drawer_and_put_the_bowl_inside",
    "libero_10/KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it",
    "libero_10/KITCHEN_SCENE4_put_the_black_bowl_in_the_bottom_drawer_of_the_cabinet_and_close_it",
    "libero_10/KITCHEN_SCENE6_put_the_yellow_and_white_mug_in_the_microwave_and_close_it",
    "libero_10/STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy",
)
TURN = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    measured = []
    for task in select_tasks(parser.parse_args().tasks):
        measured.append(compare(StarterSource().demonstration(task)))
        print(f"{task.suite}/{task.name}: {json.dumps(measured[-1])}")
    steps = sum(row["control_steps"] for row in measured)
    ours = sum(row["ours_ms"] * row["control_steps"] for row in measured) / steps
    liberos = sum(row["liberos_ms"] * row["control_steps"] for row in measured) / steps
    restores: dict[str, float] = {}
    for name in measured[0]:
        if name.startswith("restore"):
            restores[name] = median(row[name] for row in measured)
    print(
        json.dumps(
            {
                "tasks": len(measured),
                "control_steps": steps,
                "identical": all(row["identical"] for row in measured),
                "ours_ms": round(ours, 2),
                "liberos_ms": round(liberos, 2),
                "ratio": round(ours / liberos, 3),
                **{name: round(seconds, 3) for name, seconds in restores.items()},
            }
        )
    )


def compare(demo: Demo) -> dict[str, float]:
    """Replay a demonstration both ways; return ms per control step, s per restore, and equality of all numbers."""
    ours, liberos = Environment(demo.task), Environment(demo.task)
    scene = recorded_start(demo, demo.model_xml or ours.place_fixtures(0))
    begun = time.process_time()
    liberos._env.reset_from_xml_string(scene.model_xml)
    restores = [time.process_time() - begun]
    liberos.restore(scene)
    for _ in range(2):
        begun = time.process_time()
        ours.restore(scene)
        restores.append(time.process_time() - begun)
    spent, identical = np.zeros(2), True
    for first in range(0, len(demo.actions), TURN):
        reached: list[Floats] = []
        for way, (environment, step) in enumerate(((ours, ours.step), (liberos, liberos._env.step))):
            observed: list[Floats] = []
            for action in demo.actions[first : first + TURN]:
                begun = time.process_time()
                step(action)
                spent[way] += time.process_time() - begun
                observed += [
                    environment.state,
                    environment.site_alpha.astype(float),
                    np.array([environment.succeeded()]),
                ]
            reached.append(np.concatenate(observed))
        identical &= np.array_equal(reached[0], reached[1])
    ours.close()
    liberos.close()
    ours_ms, liberos_ms = spent / len(demo.actions) * 1000
    return {
        "control_steps": len(demo.actions),
        "identical": identical,
        "ours_ms": round(ours_ms, 2),
        "liberos_ms": round(liberos_ms, 2),
        "restore_liberos_s": round(restores[0], 3),
        "restore_s": round(restores[1], 3),
        "restore_again_s": round(restores[2], 4),
    }


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
