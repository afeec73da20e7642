"""What a user can get wrong."""


class InputError(ValueError):
    """A mistake in the user's input, told in one line: what, where, what to do.

    The command line prints the message without a traceback and exits with code 2.
    """
