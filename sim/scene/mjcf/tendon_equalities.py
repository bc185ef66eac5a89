"""Equalities of fixed tendons: couplings of two joints where there are no more, otherwise stiff damped tendons."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.polynomial import Polynomial

from gelflow.sim.scene.mjcf.actuators import is_fixed
from gelflow.sim.scene.mjcf.couplings import (
    RELAXATION,
    STIFFNESS,
    CouplingDef,
    TendonDef,
    active_equalities,
    joint_kind,
    tendon_terms,
)

_TENDON = (mujoco.mjtEq.mjEQ_TENDON,)
_NO_TENDON = -1


def unsupported_equality(model: Any, e: int) -> bool:
    """Whether an equality of tendons is not modelled: of spatial tendons, or nonlinear and of more than two joints."""
    tendons = [t for t in (int(model.eq_obj1id[e]), int(model.eq_obj2id[e])) if t != _NO_TENDON]
    if not all(is_fixed(model, t) for t in tendons):
        return True
    nonlinear = len(tendons) == 2 and np.any(model.eq_data[e, 2:5])
    return bool(nonlinear and any(len(tendon_terms(model, t)) > 1 for t in tendons))


def read_tendon_equalities(
    model: Any, couplings: Sequence[CouplingDef]
) -> tuple[tuple[CouplingDef, ...], tuple[TendonDef, ...]]:
    """The active equalities of fixed tendons: L₁ = L₁⁰ + P(L₂ − L₂⁰) with the lengths L⁰ of the file.

    An equality of one or two joints becomes a coupling. Its second joint follows the first, or the first the second if
    the second already follows a joint, by an equality before it or by one of `couplings`. An equality of more joints
    becomes a tendon whose spring is as stiff as that of a loop closure.
    """
    added: list[CouplingDef] = []
    springs: list[TendonDef] = []
    for e, name in active_equalities(model, _TENDON):
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        terms = tendon_terms(model, first)
        start = _length(model, terms)
        polynomial = Polynomial(model.eq_data[e, :1])
        if second != _NO_TENDON:
            others = tendon_terms(model, second)
            polynomial = Polynomial(model.eq_data[e, :5]).trim()
            if polynomial.degree() > 1:
                added.append(_nonlinear(model, name, terms, others, polynomial))
                continue
            slope = float(polynomial.deriv()(0.0))
            start -= slope * _length(model, others)
            for joint, coefficient in others.items():
                terms[joint] = terms.get(joint, 0.0) - slope * coefficient
        terms = {joint: coefficient for joint, coefficient in terms.items() if coefficient != 0}
        length = start + float(polynomial(0.0))
        if len(terms) > 2:
            springs.append(_spring(model, name, terms, length))
        elif terms:
            followers = {coupling.joint for coupling in (*couplings, *added)}
            added.append(_linear(model, name, terms, length, followers))
    return tuple(added), tuple(springs)


def _length(model: Any, terms: dict[int, float]) -> float:
    """The length of a tendon in the pose of the file."""
    return float(sum(c * model.qpos0[model.jnt_qposadr[joint]] for joint, c in terms.items()))


def _linear(model: Any, name: str, terms: dict[int, float], length: float, followers: set[int]) -> CouplingDef:
    """Σ cᵢ qᵢ = `length` of one or two joints; the second one follows the first, unless it follows another already."""
    (leader, b), *rest = terms.items()
    if not rest:
        return CouplingDef(name, leader, -1, (length / b,), joint_kind(model, leader))
    [(joint, a)] = rest
    if joint in followers:
        joint, a, leader, b = leader, b, joint, a
    return CouplingDef(name, joint, leader, (length / a, -b / a), joint_kind(model, joint))


def _nonlinear(
    model: Any, name: str, terms: dict[int, float], others: dict[int, float], polynomial: Polynomial
) -> CouplingDef:
    """c₁ q₁ = L₁⁰ + P(c₂ q₂ − L₂⁰) of one joint on each side."""
    [(joint, a)], [(leader, b)] = terms.items(), others.items()
    value = polynomial(Polynomial([-_length(model, others), b])) + _length(model, terms)
    return CouplingDef(name, joint, leader, tuple((value / a).coef.tolist()), joint_kind(model, joint))


def _spring(model: Any, name: str, terms: dict[int, float], length: float) -> TendonDef:
    hinges = any(joint_kind(model, joint) == "hinge" for joint in terms)
    stiffness = STIFFNESS["hinge" if hinges else "slide"] / max(c * c for c in terms.values())
    return TendonDef(
        name=f"{name} equality",  # most files give it the name of its tendon
        joints=tuple(terms),
        coefficients=tuple(terms.values()),
        damping=stiffness * RELAXATION,
        stiffness=stiffness,
        springref=length,
    )
