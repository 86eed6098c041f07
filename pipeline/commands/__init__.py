"""The command line: a module for each group of commands.

A command is a function with click's decorators, and its docstring is the text of its ``--help``. A module is imported
when one of its commands is called. Functions import what takes long, so that the help of a command appears at once.
"""
