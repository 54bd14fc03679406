"""Bodies of a recording's road users: vehicles of the fleet, models of the user, people."""

from skope.gen.bystanders import bystander
from skope.gen.scene.recording import RecordedVehicle
from skope.gen.vehicles.fleet import build_vehicle
from skope.gen.vehicles.model import Body, Vehicle


def body_of(recorded: RecordedVehicle) -> Body:
    """The body of a road user; equal ones are built once."""
    return vehicle_body(recorded) if recorded.labelled else bystander.build_bystander(recorded.model, recorded.shape)


def vehicle_body(recorded: RecordedVehicle) -> Vehicle:
    """The body of a labelled road user; equal ones are built once."""
    return build_vehicle(recorded.model, recorded.shape, recurs=recorded.recurs)
