"""What a user can get wrong."""


class InputError(ValueError):
    """A mistake in the user's input, told in one line: what, where, what to do.

    The command line prints the message without a traceback and exits with code 2.
    """


def how_to_install(extra: str) -> str:
    """What to do where a part of pup is not installed, in the versions that it was tested with."""
    return f"from the checkout: pip install -c constraints.txt '.[{extra}]'"
