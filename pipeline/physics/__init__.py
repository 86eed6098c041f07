"""Scenes, LIBERO's environment around them, and replaying demonstrations in it."""
