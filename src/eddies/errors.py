"""The base of errors that the user can correct."""


class UserError(Exception):
    """The text names the mistake and the remedy. A command that ends with it prints one line and has exit code 2."""
