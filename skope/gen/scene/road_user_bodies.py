"""Bodies of a recording's road users: vehicles of the fleet, models of the user, people."""

from skope.gen.bystanders import bystander
from skope.gen.scene.recording import RecordedVehicle
from skope.gen.vehicles.fleet import build
from skope.gen.vehicles.model import Body


def body_of(recorded: RecordedVehicle) -> Body:
    """The body of a road user; equal ones are built once."""
    if recorded.labelled:
        return build(recorded.model, recorded.shape, recurs=recorded.recurs)
    return bystander.build(recorded.model, recorded.shape)
