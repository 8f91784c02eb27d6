"""The one exception that a person is meant to read."""


class UserError(Exception):
    """Bad input: one line that names the file or key and how to mend it.

    Stages and the command line print it without a traceback and exit with status 1.
    """
