"""What a recording's road users look like: vehicles of the fleet, added ones, people."""

from skope.gen import bystanders, vehicles
from skope.gen.scene.recording import RecordedVehicle
from skope.gen.vehicles.model import Body


def body_of(recorded: RecordedVehicle) -> Body:
    """The body of a road user; equal ones are built once."""
    if recorded.labelled:
        return vehicles.build(recorded.model, recorded.shape)
    return bystanders.build(recorded.model, recorded.shape)
