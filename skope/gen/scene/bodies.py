"""What a recording's road users look like: vehicles of the fleet, added ones, people."""

from skope.gen.bystanders import bystander
from skope.gen.scene.recording import RecordedVehicle
from skope.gen.vehicles.fleet import build
from skope.gen.vehicles.model import Body


def body_of(recorded: RecordedVehicle) -> Body:
    """The body of a road user; equal ones are built once."""
    if recorded.labelled:
        return build(recorded.model, recorded.shape)
    return bystander.build(recorded.model, recorded.shape)
