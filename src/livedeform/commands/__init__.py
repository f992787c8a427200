"""One file per command: a function named like the command that parses, calls the library and prints.

A command imports what is heavy inside its function, so that ``livedeform --help`` answers at once. It raises the errors
of ``common.errors``; ``livedeform.cli`` is the only place that catches them.
"""
