"""The one exception that means "the user can mend this"."""

from typing import Any


class UserError(ValueError):
    """A mistake in a user's files or flags; its text is one line that names the file (or flag) and the field.

    The command line prints it without a traceback and exits with code 2. Anything else that escapes is a defect of
    skope and keeps its traceback.
    """


def one_of(field: str, value: Any, choices: tuple[str, ...]) -> str:
    """Return `value` when it is among `choices`, else raise a UserError that lists them."""
    if value not in choices:
        raise UserError(f"{field}: {value!r} is not one of {', '.join(choices)}")
    return str(value)
