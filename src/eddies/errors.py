"""The base of errors that are the user's to mend."""


class UserError(Exception):
    """The text tells what is wrong and what to do: a command that ends with it shows no traceback, and its exit code
    is 2."""
