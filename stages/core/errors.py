"""The exception for mistakes in the input."""


class InputError(Exception):
    """Invalid input: the message is one line that names the file or option, what is wrong and what would work.

    The command line prints it without a traceback and exits with status 2.
    """
