"""Options that several commands of `skope eval` take."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from skope.command_options import panel

if TYPE_CHECKING:
    from skope.eval.inference.settings import Settings

machine = panel("Machine")


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """How a checkpoint is run on this machine."""

    device: Annotated[str, machine(metavar="[auto|cpu|cuda|cuda:N]", help="Where to compute.")] = "auto"
    precision: Annotated[
        str,
        machine(
            choices=("float32", "bfloat16", "auto"), help="Of the costly parts; auto: bfloat16 where that is fast."
        ),
    ] = "float32"
    batch_size: Annotated[
        int | None, machine(help="Images that go through the network together.", show_default="1, on a GPU 8")
    ] = None

    def settings(self, **others: Any) -> "Settings":
        """The settings of inference; `others` are further ones of its fields."""
        from skope.eval.inference.settings import Settings

        return Settings(device=self.device, precision=self.precision, batch_size=self.batch_size, **others)
