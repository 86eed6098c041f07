"""The command line, a file for each family of commands.

A command is a function, whose docstring is what ``--help`` says of it. What takes long to import it imports itself, and
its arguments are added only when it is called: so ``--help`` of all is quick.
"""
