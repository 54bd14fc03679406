"""Rules of a recipe on a detector that is learnt from."""

from dataclasses import dataclass

from skope.errors import UserError


@dataclass(frozen=True, kw_only=True)
class TeacherRules:
    """The detector whose answers are learnt beside the labels, and the weight of each kind; labels count 1."""

    checkpoint: str | None = None
    """A name, run folder or file, as `--checkpoint` takes it; None: labels alone are learnt."""
    classes: float = 1.0
    boxes: float = 1.0
    keypoints: float = 1.0
    temperature: float = 1.0
    """Logits are divided by it before they become probabilities: more makes them softer."""
    sharpen: float = 1.0
    """The teacher's heat maps are multiplied by it: those of a detector whose scores were calibrated are flatter than
    what it has learnt."""

    def __post_init__(self) -> None:
        for name in ("classes", "boxes", "keypoints"):
            if not 0 <= getattr(self, name) <= 1000:
                raise UserError(f"{name}: expected 0 to 1000, got {getattr(self, name)}")
        for name in ("temperature", "sharpen"):
            if not 0.1 <= getattr(self, name) <= 100:
                raise UserError(f"{name}: expected 0.1 to 100, got {getattr(self, name)}")

    @property
    def of_boxes(self) -> bool:
        """Whether its classes or boxes count."""
        return max(self.classes, self.boxes) > 0
