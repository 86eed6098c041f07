"""Policies run on LIBERO's tasks, LIBERO-Plus's test tasks and held-out draws of the axes.

Lower modules do not know those above them:

* ``commands``: the command line. ``harness``: the same tasks for vla-eval.
* ``evaluate``: a whole evaluation. ``rollout``: an episode of it, as a worker runs it.
* ``policies``: what acts; ``checkpoint`` and ``reference_policies`` are two kinds of it.
* ``environment``: starts an episode, shows it, takes actions. ``simulator``: LIBERO's environment below it.
* ``selection``: the tasks that a user names. ``settings``: what holds for all their episodes.
* ``libero_plus``, ``asset_archive``, ``own_draws``, ``goals``: where tasks come from. ``tasks``: what a task is.
* ``findings``: what a report says, the paper's table in it. ``composition``, ``construction``: the paper's analyses.
* ``statistics``: intervals and tests. ``results``: an episode's row and the files of all.
"""
