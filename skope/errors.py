"""The exception for errors that the user can correct, and the warning for assumptions."""

from typing import Any


class UserError(ValueError):
    """Error in a user's files or flags; the message is one line that names the file (or flag) and the field.

    The command line prints it without a traceback and exits with code 2. Any other exception is a defect of skope and
    keeps its traceback.
    """


class AssumptionWarning(UserWarning):
    """Assumption about a user's file that may be wrong; the message is one line that names file and field.

    The command line prints only this line, without the position in the code.
    """


def one_of(field: str, value: Any, choices: tuple[str, ...]) -> str:
    """Check that a value is among its choices.

    Args:
        field: Name of the setting; the message begins with it.
        value: Value of the setting.
        choices: Allowed values.

    Returns:
        `value` as text.

    Raises:
        UserError: The value is not one of the choices, which the message lists.
    """
    if value not in choices:
        raise UserError(f"{field}: {value!r} is not one of {', '.join(choices)}")
    return str(value)


def first_line(error: Exception) -> str:
    """Return the first line of an exception's message, or the name of its class if it has no message."""
    return (str(error).splitlines() or [type(error).__name__])[0]
