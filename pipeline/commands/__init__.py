"""The command line: a module for each group of commands.

A command is a function with click's decorators. Its docstring is the text of its ``--help``: a first sentence with a
verb, then the files that the command writes or the lines that it prints. ``example`` adds the last lines. A module is
imported when one of its commands is called. Functions import slow modules themselves, so the help appears at once.
"""
