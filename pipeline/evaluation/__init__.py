"""Policies run on LIBERO's tasks, LIBERO-Plus's test tasks and held-out perturbations of the axes.

Modules, each above those that it uses:

* ``harness``: for vla-eval. ``lerobot_eval``: for lerobot-eval, over ``gym_environment``. ``composition``: the gap.
* ``evaluate``: all episodes, in worker processes. ``rollout``: one, from task to row. ``selection``: the tasks named.
* ``environment`` over ``simulator``: starts an episode, shows it, takes actions. ``reference_policies``, ``policies``.
* ``statistics``, ``results``; ``libero_plus``, ``own_draws``, ``tasks``: where tasks come from, and what one is.
"""
