"""Messages while the light of a new camera is worked out, during which nothing else is to be seen."""

from collections.abc import Callable

from skope.terminal.console import Console


def lighting_messages(console: Console) -> Callable[[str], None]:
    """A function that is told sites whose light is being worked out, and says each once."""
    said = set[str]()

    def say(site: str) -> None:
        if site not in said:
            said.add(site)
            console.say(f"working out the light of {site}")

    return say
