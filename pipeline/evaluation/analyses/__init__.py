"""Analyses of stored results.

* ``composition``: the compositional gap of pairs of axes.
* ``construction``, ``grading``: a benchmark of held-out perturbations, and the difficulty of its tasks.
* ``focus``: a plan whose episodes follow the failures of policies.
* ``tested``: outcomes of policies on LIBERO-Plus's test tasks; ``other_programs`` reads those of vla-eval's and
  lerobot's own LIBERO-Plus environments.
"""
