"""The one exception that means "the user can mend this", and the one warning."""

from typing import Any


class UserError(ValueError):
    """A mistake in a user's files or flags; its text is one line that names the file (or flag) and the field.

    The command line prints it without a traceback and exits with code 2. Anything else that escapes is a defect of
    skope and keeps its traceback.
    """


class AssumptionWarning(UserWarning):
    """An assumption about a user's file that leaves something open; one line that names file and field.

    The command line prints the line alone, without the place in the code.
    """


def one_of(field: str, value: Any, choices: tuple[str, ...]) -> str:
    """Check that a value is among its choices.

    Args:
        field: What the user set, with which the message begins.
        value: What it was set to.
        choices: What is allowed.

    Returns:
        `value` as text.

    Raises:
        UserError: It is none of the choices, which the message lists.
    """
    if value not in choices:
        raise UserError(f"{field}: {value!r} is not one of {', '.join(choices)}")
    return str(value)
