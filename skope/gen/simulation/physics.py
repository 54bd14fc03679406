"""The pybullet world, in which each vehicle is a multibody with a sprung chassis and four wheels that roll and steer.

SUMO determines the path of a vehicle. The vehicle's carrier (the base of the multibody) follows that path on the road.
Chassis and wheels are attached to the carrier by joints. The engine integrates the motion of the chassis (heave, pitch
and roll) on springs and dampers under the inertial loads of accelerating, braking and cornering. Motors make the wheels
roll without slip. The recorded poses are read back from the engine.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from skope.gen.simulation.pybullet_engine import engine
from skope.gen.simulation.smooth_paths import Driven
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.model import Vehicle
from skope.types import Array


@dataclass(frozen=True)
class PhysicsModel:
    """Suspension and tyre parameters of vehicles."""

    substeps: int = 3
    """Number of physics steps per SUMO step; 3 gives 120 Hz at the default step."""
    steering_links: tuple[int, int] = (3, 5)
    """Links that steer the front wheels, right and left."""
    wheel_links: tuple[int, int, int, int] = (4, 6, 7, 8)
    """Links of the wheels front right, front left, rear right, rear left; front wheels hang on their steering links."""
    gravity: float = 9.81
    """Acceleration of gravity, m/s^2."""
    mass_height: float = 0.36
    """Height of the centre of mass, as a fraction of the vehicle's height."""
    roll_height_m: float = 0.12
    """Height of the pitch and roll axes above the road, metres."""
    damping_share: float = 0.35
    """Damping ratio (fraction of critical damping), typical of passenger cars."""
    grip_mps2: float = 8.0
    """Maximum acceleration that tyres can hold on dry asphalt, m/s^2."""


PHYSICS_MODEL: Final = PhysicsModel()


_HEAVE, _PITCH, _CHASSIS = 0, 1, 2


@dataclass(frozen=True)
class Pose:
    """Pose and velocity of one vehicle in the physics engine."""

    T_world_chassis: Array
    """(4, 4) pose of the vehicle frame."""
    T_world_wheels: Array
    """(4, 4, 4) poses of the wheels: front right, front left, rear right, rear left; y is the axle, pointing left."""
    velocity: Array
    """(3,) velocity of the carrier in the world, m/s."""
    T_world_trailer: Array = field(default_factory=lambda: trailer_motion.NO_TRAILER)
    """(3, 4, 4) poses of a trailer and its two rear wheels, as in `skope.gen.scene.recording.Moment`."""


def at_rest(vehicle: Vehicle, driven: Driven) -> Pose:
    """Return the pose of a vehicle at its position in SUMO, with springs at rest and straight wheels."""
    forward = np.array([math.cos(driven.yaw) * math.cos(driven.pitch), math.sin(driven.yaw) * math.cos(driven.pitch)])
    x = np.array([*forward, math.sin(driven.pitch)])
    y = np.array([-math.sin(driven.yaw), math.cos(driven.yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    T[:3, 3] = driven.position
    wheels = np.tile(T, (4, 1, 1))
    wheels[:, :3, 3] += vehicle.shape.wheel_centers() @ T[:3, :3].T
    return Pose(T, wheels, driven.speed * x, trailer_motion.trailer_poses(vehicle, driven.trailer, T))


@dataclass
class _Suspension:
    """Springs and dampers of heave (N/m), pitch and roll (N m/rad), and lever arm of the inertial loads (m)."""

    stiffness: tuple[float, float, float]
    damping: tuple[float, float, float]
    mass: float
    lever: float

    @classmethod
    def of(cls, vehicle: Vehicle) -> "_Suspension":
        length, width, height = vehicle.size_lwh
        lever = PHYSICS_MODEL.mass_height * height - PHYSICS_MODEL.roll_height_m
        inertia = (
            vehicle.mass,
            vehicle.mass * ((length**2 + height**2) / 12 + lever**2),
            vehicle.mass * ((width**2 + height**2) / 12 + lever**2),
        )
        # Per g of acceleration a car pitches by about 2 degrees and rolls by about 5 degrees; it heaves at 1.3 Hz.
        per_g = vehicle.mass * PHYSICS_MODEL.gravity * lever
        heave, pitch, roll = vehicle.mass * (2 * math.pi * 1.3) ** 2, per_g / math.radians(2), per_g / math.radians(5)
        damping = [
            2 * PHYSICS_MODEL.damping_share * math.sqrt(k * i)
            for k, i in zip((heave, pitch, roll), inertia, strict=True)
        ]
        return cls((heave, pitch, roll), (damping[0], damping[1], damping[2]), vehicle.mass, lever)

    def forces(self, joints: Sequence[Sequence[float]], ahead: float, aside: float) -> list[float]:
        """Compute the lifting force on the chassis (N) and the torques that push nose and right side down (N m).

        `joints` are position and speed of heave, pitch and roll. The body accelerates by `ahead` and `aside`, m/s^2.
        The inertial force acts on the centre of mass, at a lever arm above the axes. Braking pushes the nose down,
        which is positive about y. A left turn leans the body to the right, which is positive about x.
        """
        thrust = self.mass * self.lever
        loads = (0.0, -thrust * ahead, thrust * aside)
        rows = zip(loads, self.stiffness, self.damping, joints, strict=True)
        return [load - k * joint[0] - c * joint[1] for load, k, c, joint in rows]


class _Body:
    """Multibody of one vehicle, with the carrier's motion in the last step."""

    def __init__(self, engine: Any, client: int, vehicle: Vehicle, start: Driven) -> None:
        self.engine, self.client, self.vehicle = engine, client, vehicle
        self.suspension = _Suspension.of(vehicle)
        wheels = vehicle.shape.wheel_centers()
        self.wheels = [(float(x) - vehicle.shape.rear_axle_x, float(y)) for x, y, _ in wheels]
        self.state = start
        self.load = (0.0, 0.0)
        self.velocity = at_rest(vehicle, start).velocity
        self.id = self._create()
        self._place(start.position, start.yaw, start.pitch)

    def _create(self) -> int:
        e, wheels = self.engine, self.vehicle.shape.wheel_centers().tolist()
        x, y, z, here = [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.0, 0.0, 0.0]
        heave, turn, light, wheel = e.JOINT_PRISMATIC, e.JOINT_REVOLUTE, 1.0, 20.0
        # mass, position on the parent, parent (0 is the carrier, i + 1 is link i), joint, axis
        links: list[tuple[float, list[float], int, int, list[int]]] = [
            (light, [0, 0, PHYSICS_MODEL.roll_height_m], 0, heave, z),
            (light, here, 1, turn, y),
            (self.vehicle.mass, here, 2, turn, x),
            (light, wheels[0], 0, turn, z),
            (wheel, here, 4, turn, y),
            (light, wheels[1], 0, turn, z),
            (wheel, here, 6, turn, y),
            (wheel, wheels[2], 0, turn, y),
            (wheel, wheels[3], 0, turn, y),
        ]
        count = len(links)
        upright = [[0, 0, 0, 1]] * count
        body = e.createMultiBody(
            baseMass=0,
            linkMasses=[link[0] for link in links],
            linkCollisionShapeIndices=self._shapes(count),
            linkVisualShapeIndices=[-1] * count,
            linkPositions=[link[1] for link in links],
            linkOrientations=upright,
            linkInertialFramePositions=[
                [0.0, 0.0, self.suspension.lever if link == _CHASSIS else 0.0] for link in range(count)
            ],
            linkInertialFrameOrientations=upright,
            linkParentIndices=[link[2] for link in links],
            linkJointTypes=[link[3] for link in links],
            linkJointAxis=[link[4] for link in links],
            physicsClientId=self.client,
        )
        for link in range(count):
            e.setCollisionFilterGroupMask(body, link, 0, 0, physicsClientId=self.client)
            damping = {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0}
            e.changeDynamics(body, link, **damping, physicsClientId=self.client)
            # Joints are created with a velocity motor that holds them; these joints must move freely.
            e.setJointMotorControl2(body, link, e.VELOCITY_CONTROL, force=0, physicsClientId=self.client)
        return int(body)

    def _shapes(self, count: int) -> list[int]:
        """Create a collision shape per link, from which the engine computes the inertia; nothing collides."""
        e, s = self.engine, self.vehicle.shape
        half = [side / 2 for side in self.vehicle.size_lwh]
        hub = e.createCollisionShape(e.GEOM_SPHERE, radius=0.1, physicsClientId=self.client)
        box = e.createCollisionShape(e.GEOM_BOX, halfExtents=half, physicsClientId=self.client)
        wheel = e.createCollisionShape(e.GEOM_SPHERE, radius=s.wheel_radius, physicsClientId=self.client)
        return [
            box if link == _CHASSIS else wheel if link in PHYSICS_MODEL.wheel_links else hub for link in range(count)
        ]

    def _place(self, position: Any, yaw: float, pitch: float) -> None:
        orientation = self.engine.getQuaternionFromEuler([0, -pitch, yaw])
        self.engine.resetBasePositionAndOrientation(self.id, position, orientation, physicsClientId=self.client)

    def aim(self, target: Driven, dt: float) -> None:
        """Set the carrier's motion in the coming step, the spring loads, and the speed and angle of the wheels."""
        before = self.state
        turn = _angle(target.yaw - before.yaw) / dt
        slope = PHYSICS_MODEL.gravity * math.sin(target.pitch)
        loads = ((target.speed - before.speed) / dt + slope, target.speed * turn)
        # SUMO's drivers can brake and turn harder than tyres allow, and they choose a new speed at each step. The load
        # is therefore limited, and smoothed over 0.1 s, the time in which tyres build up a force.
        share = dt / (0.1 + dt)
        ahead, aside = (
            old + (_clamp(new, PHYSICS_MODEL.grip_mps2) - old) * share
            for old, new in zip(self.load, loads, strict=True)
        )
        self.load = ahead, aside
        if target is not before:  # equal for a vehicle that was just added
            self.velocity = (np.array(target.position) - before.position) / dt
        e, radius = self.engine, self.vehicle.shape.wheel_radius
        # Each wheel rolls at the speed of its own position on the vehicle: outer wheels are faster in a curve.
        rolling = [math.hypot(target.speed - turn * y, turn * x) / radius for x, y in self.wheels]
        e.setJointMotorControlArray(
            self.id,
            PHYSICS_MODEL.wheel_links,
            e.VELOCITY_CONTROL,
            targetVelocities=rolling,
            forces=[2e4] * 4,
            physicsClientId=self.client,
        )
        e.setJointMotorControlArray(
            self.id,
            PHYSICS_MODEL.steering_links,
            e.POSITION_CONTROL,
            targetPositions=self._steering(turn, target.speed),
            forces=[2e3] * 2,
            positionGains=[0.2] * 2,
            physicsClientId=self.client,
        )

    def _steering(self, turn: float, speed: float) -> list[float]:
        """Return the Ackermann angles of the front wheels (right, left) for a yaw rate, radians."""
        s = self.vehicle.shape
        curvature = _clamp(turn / speed, 0.2) if speed > 0.5 else 0.0
        return [
            _clamp(math.atan2(s.wheelbase * curvature, 1 - side * curvature * s.track / 2), 0.7) for side in (-1, 1)
        ]

    def substep(self, target: Driven, share: float) -> None:
        """Move the carrier to the fraction `share` of its step and apply the spring forces."""
        before = self.state
        position = [a + (b - a) * share for a, b in zip(before.position, target.position, strict=True)]
        yaw = before.yaw + _angle(target.yaw - before.yaw) * share
        self._place(position, yaw, before.pitch + (target.pitch - before.pitch) * share)
        e = self.engine
        joints = e.getJointStates(self.id, (_HEAVE, _PITCH, _CHASSIS), physicsClientId=self.client)
        e.setJointMotorControlArray(
            self.id,
            (_HEAVE, _PITCH, _CHASSIS),
            e.TORQUE_CONTROL,
            forces=self.suspension.forces([joint[:2] for joint in joints], *self.load),
            physicsClientId=self.client,
        )

    def pose(self) -> Pose:
        links = self.engine.getLinkStates(
            self.id, (_CHASSIS, *PHYSICS_MODEL.wheel_links), computeForwardKinematics=1, physicsClientId=self.client
        )
        frames = np.tile(np.eye(4), (5, 1, 1))
        for frame, link in zip(frames, links, strict=True):
            frame[:3, :3] = np.array(self.engine.getMatrixFromQuaternion(link[5])).reshape(3, 3)
            frame[:3, 3] = link[4]
        chassis = frames[0].copy()
        chassis[:3, 3] -= chassis[:3, :3] @ [0, 0, PHYSICS_MODEL.roll_height_m]
        trailer = trailer_motion.trailer_poses(self.vehicle, self.state.trailer, chassis)
        return Pose(chassis, frames[1:], self.velocity.copy(), trailer)


class World:
    """All vehicles near a camera. Use as a context manager."""

    def __init__(self, dt: float) -> None:
        """Create an empty world; `dt` is the time between two calls of `advance`, seconds."""
        self._dt = dt
        self._bodies: dict[str, _Body] = {}

    def __enter__(self) -> "World":
        self._engine = engine()
        self._client = self._engine.connect(self._engine.DIRECT)
        self._engine.setPhysicsEngineParameter(
            fixedTimeStep=self._dt / PHYSICS_MODEL.substeps,
            deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.disconnect(self._client)

    def advance(self, driven: dict[str, tuple[Vehicle, Driven]]) -> None:
        """Drive vehicles to the states in `driven`; add new ones with springs at rest and remove absent ones."""
        for name in self._bodies.keys() - driven.keys():
            self._engine.removeBody(self._bodies.pop(name).id, physicsClientId=self._client)
        for name, (vehicle, state) in driven.items():
            if name not in self._bodies:
                self._bodies[name] = _Body(self._engine, self._client, vehicle, state)
            self._bodies[name].aim(state, self._dt)
        for k in range(PHYSICS_MODEL.substeps):
            for name, body in self._bodies.items():
                body.substep(driven[name][1], (k + 1) / PHYSICS_MODEL.substeps)
            self._engine.stepSimulation(physicsClientId=self._client)
        for name, body in self._bodies.items():
            body.state = driven[name][1]

    def poses(self) -> dict[str, Pose]:
        """Return the current poses of all vehicles in the engine, by name."""
        return {name: body.pose() for name, body in self._bodies.items()}


def _angle(value: float) -> float:
    """Wrap an angle to the range from -pi to pi."""
    return math.remainder(value, 2 * math.pi)


def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
