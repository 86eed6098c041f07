"""Evaluation of policies on LIBERO's tasks, LIBERO-Plus's test tasks and held-out perturbations of the axes.

Modules, each listed above the modules that it uses:

* ``harness``: for vla-eval. ``lerobot_eval``: for lerobot-eval, over ``gym_environment``. ``composition``: the gap.
* ``evaluate``: all episodes, in worker processes. ``rollout``: one episode, from task to row. ``selection``: tasks.
* ``environment`` over ``simulator``: starts episodes, observes, takes actions. ``reference_policies``, ``policies``.
* ``statistics``, ``results``; ``libero_plus``, ``held_out``, ``tasks``: sources of tasks, and their identification.
"""
