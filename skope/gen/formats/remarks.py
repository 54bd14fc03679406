"""Doubts and omissions of an import, said once each with how often it was met and where first."""

from skope.terminal.console import Console, counted


class Remarks:
    """Collects remarks while records are read one after the other."""

    def __init__(self) -> None:
        self._met: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, noun: str, text: str, where: str) -> None:
        """Note that `text` holds for one more thing that `noun` names, at `where`."""
        count, first = self._met.get((noun, text), (0, where))
        self._met[noun, text] = count + 1, first

    def say(self, console: Console) -> None:
        """Say all that was noted, in the order in which it was first met."""
        for (noun, text), (count, where) in self._met.items():
            console.warn(f"{counted(count, noun)} {text}; first: {where}")
