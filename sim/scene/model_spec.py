"""Conversion of the elements of a scene to definitions of the C++ core."""

from collections.abc import Mapping, Sequence

import numpy as np

from gelflow.sim import _core
from gelflow.sim.scene.contacts import ContactDef, PointsDef
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid
from gelflow.sim.scene.joint_limits import JointLimit
from gelflow.sim.scene.mjcf.actuators import ActuatorDef
from gelflow.sim.scene.mjcf.couplings import RELAXATION, STIFFNESS, CouplingDef, LoopClosureDef, TendonDef
from gelflow.sim.scene.mjcf.mechanics import BodyDef, JointDef
from gelflow.sim.scene.pads import PadDef
from gelflow.sim.scene.shapes import ShapeDef


def add_bodies(
    spec: _core.ModelSpec, bodies: Sequence[BodyDef], joints: Sequence[JointDef], limits: Sequence[JointLimit]
) -> None:
    """Add each body, followed by its joints."""
    for index, body in enumerate(bodies):
        spec.add_body(_body(body))
        for joint, limit in zip(joints, limits, strict=True):
            if joint.body == index:
                spec.add_joint(_joint(joint, limit))


def add_contacts(
    spec: _core.ModelSpec,
    shapes: Sequence[ShapeDef],
    points: Sequence[PointsDef],
    contacts: Sequence[ContactDef],
    pads: Sequence[PadDef],
) -> None:
    """Add shapes and point sets, and the contacts and pads that refer to them by name."""
    shape_index = {shape.name: spec.add_shape(core_shape(shape)) for shape in shapes}
    points_index = {p.name: spec.add_points(_points(p)) for p in points}
    for contact in contacts:
        spec.add_contact(_contact(contact, points_index, shape_index))
    for pad in pads:
        spec.add_pad(_pad(pad, shape_index))


def add_couplings(
    spec: _core.ModelSpec,
    tendons: Sequence[TendonDef],
    couplings: Sequence[CouplingDef],
    loop_closures: Sequence[LoopClosureDef],
) -> None:
    """Add tendons, couplings and loop closures, after the joints and bodies that they refer to."""
    for tendon in tendons:
        spec.add_tendon(_tendon(tendon))
    for coupling in couplings:
        spec.add_coupling(_coupling(coupling))
    for closure in loop_closures:
        spec.add_loop_closure(_loop_closure(closure))


def add_actuators(spec: _core.ModelSpec, actuators: Sequence[ActuatorDef]) -> None:
    """Add the actuators, after the joints and tendons that they drive."""
    for actuator in actuators:
        spec.add_actuator(_actuator(actuator))


def core_grid(grid: DistanceGrid) -> _core.DistanceGrid:
    """A distance grid as the core takes it."""
    return _core.DistanceGrid(origin=grid.origin, spacing=grid.spacing, coefficients=grid.coefficients)


def _body(body: BodyDef) -> _core.BodyDef:
    return _core.BodyDef(
        name=body.name,
        parent=body.parent,
        pos=body.pose.position,
        quat=body.pose.quaternion,
        mass=body.mass,
        com=body.com,
        inertia=body.inertia,
        gravcomp=body.gravcomp,
        gravcomp_pos=body.gravcomp_pos,
    )


def _joint(joint: JointDef, limit: JointLimit) -> _core.JointDef:
    lower, upper = joint.range or (-np.inf, np.inf)
    return _core.JointDef(
        name=joint.name,
        body=joint.body,
        type=joint.type,
        pos=joint.pos,
        axis=joint.axis,
        ref=joint.ref,
        damping=joint.damping,
        armature=joint.armature,
        stiffness=joint.stiffness,
        springref=joint.springref,
        lower=lower,
        upper=upper,
        limit_stiffness=limit.stiffness,
        limit_damping=limit.damping,
        frictionloss=joint.frictionloss,
        prescribed=joint.prescribed,
    )


def core_shape(shape: ShapeDef) -> _core.ShapeDef:
    """The definition of a shape for the core."""
    grid = shape.grid
    return _core.ShapeDef(
        name=shape.name,
        body=shape.body,
        kind=shape.kind if grid is None else "grid",
        pos=shape.pose.position,
        quat=shape.pose.quaternion,
        size=shape.size,
        rounding=shape.rounding if grid is None else 0.0,  # the distances of a grid contain the rounding
        grid=core_grid(grid) if grid is not None else None,
    )


def _points(points: PointsDef) -> _core.PointsDef:
    return _core.PointsDef(
        name=points.name,
        body=points.body,
        points=points.points,
        weights=points.weights,
        radius=points.radius,
        pos=points.pose.position,
        quat=points.pose.quaternion,
        areas=points.areas if points.per_area else None,
    )


def _contact(contact: ContactDef, points: Mapping[str, int], shapes: Mapping[str, int]) -> _core.ContactDef:
    return _core.ContactDef(
        name=contact.name,
        points=points[contact.points],
        shape=shapes[contact.shape],
        law=contact.law,
        damping=contact.damping,
        **contact.params,
    )


def _pad(pad: PadDef, shapes: Mapping[str, int]) -> _core.PadDef:
    return _core.PadDef(
        name=pad.name,
        body=pad.body,
        positions=pad.positions,
        axes=pad.axes,
        shapes=[shapes[name] for name in pad.against],
        law=pad.law,
        weights=pad.weights,
        pos=pad.pose.position,
        quat=pad.pose.quaternion,
        collides=pad.collides,
        **pad.params,
    )


def _tendon(tendon: TendonDef) -> _core.TendonDef:
    lower, upper = tendon.range or (-np.inf, np.inf)
    return _core.TendonDef(
        name=tendon.name,
        joints=tendon.joints,
        coefficients=tendon.coefficients,
        damping=tendon.damping,
        armature=tendon.armature,
        stiffness=tendon.stiffness,
        springref=tendon.springref,
        lower=lower,
        upper=upper,
        limit_stiffness=tendon.limit[0],
        limit_damping=tendon.limit[1],
        frictionloss=tendon.frictionloss,
    )


def _coupling(coupling: CouplingDef) -> _core.CouplingDef:
    stiffness = STIFFNESS[coupling.kind]
    return _core.CouplingDef(
        name=coupling.name,
        joint=coupling.joint,
        leader=coupling.leader,
        coefficients=coupling.coefficients,
        stiffness=stiffness,
        damping=RELAXATION * stiffness,
    )


def _loop_closure(closure: LoopClosureDef) -> _core.LoopClosureDef:
    return _core.LoopClosureDef(
        name=closure.name,
        first=closure.bodies[0],
        second=closure.bodies[1],
        first_pos=closure.points[0],
        second_pos=closure.points[1],
        weld=closure.weld,
        quat=(1, 0, 0, 0) if closure.quaternion is None else closure.quaternion,
        stiffness=STIFFNESS["slide"],
        damping=RELAXATION * STIFFNESS["slide"],
        turn_stiffness=STIFFNESS["hinge"],
        turn_damping=RELAXATION * STIFFNESS["hinge"],
    )


def _actuator(actuator: ActuatorDef) -> _core.ActuatorDef:
    return _core.ActuatorDef(
        name=actuator.name,
        joint=actuator.joint,
        tendon=actuator.tendon,
        kind=actuator.kind,
        gear=actuator.gear,
        kp=actuator.kp,
        kd=actuator.kd,
        force_lower=actuator.force_range[0],
        force_upper=actuator.force_range[1],
        ctrl_lower=actuator.ctrl_range[0],
        ctrl_upper=actuator.ctrl_range[1],
        gain=actuator.gain,
        bias=actuator.bias,
    )
