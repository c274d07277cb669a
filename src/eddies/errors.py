"""The base class of errors that the user can correct."""


class UserError(Exception):
    """An error whose text names the mistake and the remedy.

    A command that ends with this error prints one line and has exit code 2.
    """
