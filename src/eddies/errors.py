"""The base class of errors that the user can correct."""


class UserError(Exception):
    """An error whose text names the mistake and the remedy.

    A command that ends with this error prints one line and has exit code 2. The error can be sent to another rank.
    """

    def __reduce__(self) -> tuple:
        return type(self).__new__, (type(self), str(self)), vars(self)  # without __init__, which may build the text
