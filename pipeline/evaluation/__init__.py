"""Policies run on LIBERO's tasks, LIBERO-Plus's test tasks and held-out draws of the axes.

An episode goes from a task to an environment, in which a policy acts, to a row and a summary. Lower modules do not know
those above them:

* ``commands``: the command line. ``harness``: the same tasks and rows for vla-eval. ``lerobot_eval``: for lerobot-eval,
  over ``gym_environment``.
* ``evaluate``: all episodes that were selected, in worker processes. ``rollout``: one of them, from task to row.
* ``selection``: the tasks that a user names, or a benchmark of one's own.
* ``environment``: starts an episode, shows it, takes actions. ``simulator``: LIBERO's environment below it.
* ``policies``: what acts. ``reference_policies``: the demonstrations, as a check.
* ``statistics``: rates, intervals, comparisons, difficulty. ``composition``: the compositional gap of two axes.
* ``results``: an episode's row, the files of all, and which can be compared.
* ``libero_plus``, ``own_draws``: where test tasks and held-out draws come from. ``tasks``: what a task is, and other
  goals for LIBERO's.
"""
