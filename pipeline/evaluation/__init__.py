"""Policies run on LIBERO's tasks, LIBERO-Plus's test tasks and held-out draws of the axes."""
