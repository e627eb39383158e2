"""The one exception that is the user's to read."""


class InputError(Exception):
    """A mistake in what the user gave us: one sentence that names the file or option, what is
    wrong and what would work. The command line prints it and exits with status 2."""
