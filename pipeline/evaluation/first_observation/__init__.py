"""Comparison of a user's first observation with this project's frame of the same start.

* ``frame_report``: the differences, each with its remedy.
* ``frame_search``: search for the view, orientation and start that a picture shows.
* ``start_frames``: frames of the starts that evaluations confuse.
* ``picture_fit``, ``picture_points``: comparison of a picture with one frame, by pixels and by common points.
"""
