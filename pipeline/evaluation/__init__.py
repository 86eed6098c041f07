"""Evaluation of policies on LIBERO's tasks, LIBERO-Plus's test tasks and held-out perturbations of the axes.

Modules, those of an evaluation from the command to its parts:

* ``evaluate``: all episodes, in worker processes. ``setting_checks``: rejected settings. ``evaluation``: names,
  versions and results of the episodes. ``rollout``: one episode.
* ``selection``, ``task_list``: the tasks of an evaluation. ``tasks``: their identification. ``libero_plus``, ``goals``,
  ``held_out`` with ``held_out_sight``, ``recordings``: their sources.
* ``environment`` over ``simulator``: starts episodes, observes, takes actions.
* ``policies``: interface of a policy. ``policy_config``: its configuration. ``model_server``, ``checkpoint``,
  ``reference_policies``: policies. ``actions``: checks of their answers.
* ``results``, ``statistics``: stored results, and their rates and intervals.

Evaluations by other programs: ``harness`` for vla-eval; ``lerobot_eval`` for lerobot-eval, over ``gym_environment``.
Configurations of users name these two modules, so their paths stay.

Folders: ``analyses`` of stored results, such as the compositional gap; ``first_observation``, the comparison of a
user's picture with our frame.
"""
