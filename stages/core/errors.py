"""Exceptions for mistakes in the input and in the installation."""


class InputError(Exception):
    """Invalid input. The message is one line that names the file or option, what is wrong and what would work.

    The command line prints it without a traceback and exits with status 2.
    """


class MissingPackage(InputError):
    """A package that an input or option needs is missing or incomplete; the message says how to install it."""
